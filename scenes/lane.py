"""Lanes beside the recorded path: a place is so many metres along that path and so many to its left."""

from __future__ import annotations

import torch

from scenes.trajectory import Trajectory

SPACING = 0.5
"""Metres between the points that a path is reduced to: standing, a body shakes on the spot."""

STRAIGHT = 4.0
"""Metres at either end that say where the path goes on."""


class Lane:
    """The path of a body over the ground, drawn on straight beyond its ends. Lengths in metres from its first point."""

    def __init__(self, path: Trajectory):
        """A body that moves less than a metre gives the straight line along its heading."""
        xy = path.world_from_body[:, :2, 3]
        kept = [xy[0]]
        for point in xy[1:]:
            if float((point - kept[-1]).norm()) >= SPACING:
                kept.append(point)
        points = torch.stack(kept)
        if float((points[-1] - points[0]).norm()) < 1.0:
            forward = torch.nn.functional.normalize(path.world_from_body[0, :2, 0], dim=0)
            points = torch.stack([xy[0], xy[0] + forward])
        self.points = points
        self.lengths = torch.cat([torch.zeros(1, dtype=torch.float64), points.diff(dim=0).norm(dim=1).cumsum(0)])
        self._ends = self._along(0.0, STRAIGHT), self._along(float(self.lengths[-1]) - STRAIGHT, float(self.lengths[-1]))

    def at(self, along: torch.Tensor, left: float) -> tuple[torch.Tensor, torch.Tensor]:
        """World points `[T, 2]` and headings `[T]` in radians, at lengths `[T]` of the path and metres to its left."""
        last = float(self.lengths[-1])
        on_path = self._point(along.clamp(0, last))
        ahead = torch.stack([self._direction(float(s)) for s in along])
        on_path = on_path + (along - along.clamp(0, last))[:, None] * ahead
        side = torch.stack([-ahead[:, 1], ahead[:, 0]], 1)
        return on_path + left * side, torch.atan2(ahead[:, 1], ahead[:, 0])

    def gone(self, along: float, left: float, metres: torch.Tensor) -> torch.Tensor:
        """Lengths `[T]` along the path after `metres` `[T]` of a way that keeps so far to its left: the inside of a bend is shorter."""
        reach = 2 * float(metres.abs().max()) + 4 * SPACING
        grid = along + torch.linspace(-reach, reach, 2 * round(reach / SPACING) + 1, dtype=torch.float64)
        way = self.at(grid, left)[0].diff(dim=0).norm(dim=1).cumsum(0)
        way = torch.cat([torch.zeros(1, dtype=torch.float64), way])
        way = way - way[len(way) // 2]
        k = torch.searchsorted(way, metres).clamp(1, len(way) - 1)
        return torch.lerp(grid[k - 1], grid[k], (metres - way[k - 1]) / (way[k] - way[k - 1]).clamp_min(1e-9))

    def of(self, xy: torch.Tensor) -> tuple[float, float]:
        """Metres along the path and to its left of a world point `[2]`: `at` of them is that point again, but in the tightest bends."""
        a, b = self.points[:-1], self.points[1:]
        step = b - a
        u = ((xy - a) * step).sum(1) / (step * step).sum(1)
        low, high = torch.zeros(len(u), dtype=torch.float64), torch.ones(len(u), dtype=torch.float64)
        low[0], high[-1] = -torch.inf, torch.inf
        u = torch.minimum(torch.maximum(u, low), high)
        nearest = int((xy - a - u[:, None] * step).norm(dim=1).argmin())
        along = float(self.lengths[nearest] + u[nearest] * step[nearest].norm())
        # the direction is a smooth one, so the foot is moved until the point lies square to it
        for _ in range(8):
            foot, heading = self.at(torch.tensor([along], dtype=torch.float64), 0.0)
            ahead = torch.cat([heading.cos(), heading.sin()])
            along += float((xy - foot[0]) @ ahead) * 0.8
        foot, heading = self.at(torch.tensor([along], dtype=torch.float64), 0.0)
        left = float((xy - foot[0]) @ torch.cat([-heading.sin(), heading.cos()]))
        return along, left

    def _point(self, along: torch.Tensor) -> torch.Tensor:
        k = torch.searchsorted(self.lengths, along).clamp(1, len(self.lengths) - 1)
        u = (along - self.lengths[k - 1]) / (self.lengths[k] - self.lengths[k - 1])
        return torch.lerp(self.points[k - 1], self.points[k], u[:, None])

    def _along(self, start: float, end: float) -> torch.Tensor:
        ends = self._point(torch.tensor([start, end], dtype=torch.float64).clamp(0, float(self.lengths[-1])))
        return torch.nn.functional.normalize(ends[1] - ends[0], dim=0)

    def _direction(self, along: float) -> torch.Tensor:
        """Unit direction `[2]`: over two metres each way, and near the ends gradually that of the ends."""
        last, first_way, last_way = float(self.lengths[-1]), *self._ends
        if along <= 0:
            return first_way
        if along >= last:
            return last_way
        here = self._along(max(0.0, along - STRAIGHT / 2), min(last, along + STRAIGHT / 2))
        share = min(1.0, along / STRAIGHT, (last - along) / STRAIGHT)
        end = first_way if along < last - along else last_way
        return torch.nn.functional.normalize(share * here + (1 - share) * end, dim=0)
