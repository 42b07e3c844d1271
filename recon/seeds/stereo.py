"""How far away everything in a picture is, as pictures of the same place from elsewhere tell it.

Plane sweep over inverse depth (Collins 1996), likeness by normalised cross-correlation, smoothed along scanlines by semi-global matching
(Hirschmüller 2008).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from scenes.camera import Camera
from scenes.poses import inverse

WIDTH = 256
"""Columns at which pictures are compared, at most."""

PLANES = 96
"""Inverse depths that are tried, in equal steps from 0 (the sky) on."""

CHUNK = 16
"""Inverse depths that are looked at together: what they need stays in the cache."""

WINDOW = 5
"""Side of the squares that are correlated, in pixels."""

FLAT = 2.0
"""Levels of 255 of noise: squares whose contrast is not above it look like nothing in particular."""

GREY = 128.0
"""Level that plates count from: sums of squares lose less."""

NUDGE, JUMP = 0.06, 0.5
"""What it costs a pixel to be one inverse depth off its neighbour, or any number; a correlation of 1 costs 0, of none 1."""

EDGE = 12.0
"""Levels between neighbours at which a jump costs half."""

UNSEEN = 0.7
"""What it costs to be where no other picture looks: less than to be far away, where all look, and look like nothing there."""

PINNED = 1.0
"""What it costs the pixel of a known point to be elsewhere."""

UNDERGROUND, ON_LIMIT = 2.0, 0.25
"""What it costs to be under the ground, and how many inverse depths above the limit nothing is believed."""

BEYOND = 0.5
"""Inverse depths up to which things are too far to be told from what moves with the camera."""


@dataclass(frozen=True)
class Plate:
    """A picture as a pinhole camera sees it: grey levels `[h, w]` float32 less `GREY`, focal length and centre in pixels, `cam_from_world`
    `[4, 4]`.

    at: where its pixels lie in the picture that it was made from, `[h, w, 2]` in that one's pixels; `inside` `[h, w]` whether they do.
    """

    grey: torch.Tensor
    focal: tuple[float, float]
    centre: tuple[float, float]
    cam_from_world: np.ndarray
    at: torch.Tensor
    inside: np.ndarray

    def contrast(self) -> np.ndarray:
        """Standard deviation `[h, w]` of the grey levels in the squares that are compared, noise taken off, in parts of their mean."""
        mean, spread = _moments(self.grey[None])
        return ((spread.square() - FLAT * FLAT).clamp_min(0).sqrt() / (mean + GREY).clamp_min(1))[0].numpy()

    def rays(self) -> torch.Tensor:
        """Directions `[h, w, 3]` of its pixels, z = 1."""
        h, w = self.grey.shape
        y, x = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
        return torch.stack([(x - self.centre[0]) / self.focal[0], (y - self.centre[1]) / self.focal[1], torch.ones_like(x)], -1)

    def eye(self) -> np.ndarray:
        """Where it was taken, `[3]` in the world."""
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]

    def axis(self) -> np.ndarray:
        """The direction `[3]` in which it looks."""
        return self.cam_from_world[2, :3]

    def shown(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Row, column, depth z and whether in view, each `[...]`, of world points `[..., 3]`; row and column are 0 where not in view."""
        local = points @ self.cam_from_world[:3, :3].T + self.cam_from_world[:3, 3]
        z = local[..., 2]
        before = z > 1e-3
        x, y = (local[..., k] / np.where(before, z, 1.0) * self.focal[k] + self.centre[k] for k in (0, 1))
        inside = before & (x >= 0) & (y >= 0) & (x < self.grey.shape[1]) & (y < self.grey.shape[0])
        return np.where(inside, y, 0).astype(np.int64), np.where(inside, x, 0).astype(np.int64), z, inside


def plate_of(image: torch.Tensor, camera: Camera) -> Plate:
    """The plate of an image `[H, W, 3]` uint8 of a camera of its size: no more than `WIDTH` wide, its lens undone."""
    shrink = min(1.0, WIDTH / camera.width)
    w, h = max(16, round(camera.width * shrink)), max(16, round(camera.height * shrink))
    small = camera.resized(w, h)
    grey = F.interpolate(image.float().mean(2)[None, None], (h, w), mode="area") - GREY
    focal = small.lens.focal()
    plate = Plate(grey[0, 0], (float(focal[0]), float(focal[1])), (w / 2, h / 2), inverse(camera.world_from_cam).numpy(), grey, np.ones(0))
    rays = plate.rays().double()
    at = small.lens.project(rays).float()
    inside = small.lens.valid(rays) & (at > 0).all(-1) & (at[..., 0] < w) & (at[..., 1] < h)
    grid = 2 * at / torch.tensor([w, h]) - 1
    shown = F.grid_sample(grey, grid.nan_to_num(9.0)[None], mode="bilinear", padding_mode="border", align_corners=False)[0, 0]
    scale = torch.tensor([camera.width / w, camera.height / h])
    return Plate(shown, plate.focal, plate.centre, plate.cam_from_world, at * scale, inside.numpy())


def swept(plate: Plate, others: list[Plate], nearest: float, points: np.ndarray, deepest: np.ndarray) -> np.ndarray:
    """Depth z `[h, w]` of a plate's pixels as `others`, of its size, tell it; NaN where they do not.

    nearest: metres to the nearest depth that is tried; points: world points `[N, 3]` that it is known to show; deepest: depth `[h, w]` of
    the ground, infinite above the horizon.
    """
    inverse_depths = torch.linspace(0, 1 / nearest, PLANES)
    step = float(inverse_depths[1])
    cost = _costs(plate, others, inverse_depths)
    nowhere = cost == UNSEEN
    _pin(cost, plate, points, step)
    floor = torch.from_numpy(1 / deepest).float() / step
    cost += UNDERGROUND * (torch.arange(PLANES) < (floor[..., None] - 1.0))
    cost = _smoothed(cost, plate.grey)
    best = cost.argmin(2)
    middle = best.clamp(1, PLANES - 2)
    before, here, after = (cost.gather(2, (middle + d)[..., None])[..., 0] for d in (-1, 0, 1))
    bend = (before + after - 2 * here).clamp_min(1e-6)
    between = torch.where(best == middle, middle + (0.5 * (before - after) / bend).clamp(-0.5, 0.5), best.float())
    # what would rather be under the ground lies on the limit in all pictures, and what moves with the camera seems infinitely far in all
    known = ~nowhere.gather(2, best[..., None])[..., 0] & (between > floor + ON_LIMIT) & (between > BEYOND)
    return torch.where(known, 1 / (between * step).clamp_min(1e-6), torch.nan).numpy()


def _costs(plate: Plate, others: list[Plate], inverse_depths: torch.Tensor) -> torch.Tensor:
    """1 - correlation `[h, w, D]`, the mean of the better half of the others (they may not see the place); `UNSEEN` where none shows it."""
    h, w = plate.grey.shape
    rays = plate.rays().contiguous()
    motions = [torch.from_numpy(other.cam_from_world @ np.linalg.inv(plate.cam_from_world)).float() for other in others]
    rays_there = [(rays @ motion[:3, :3].T).movedim(2, 0) for motion in motions]
    mean, spread = _moments(plate.grey[None])
    costs = torch.empty(h, w, len(inverse_depths))
    for k, part in enumerate(inverse_depths.split(CHUNK)):
        best = second = torch.full((len(part), h, w), 2.0)
        for other, motion, turned in zip(others, motions, rays_there, strict=True):
            x, y, z = (turned[axis] + part[:, None, None] * motion[axis, 3] for axis in range(3))
            cost, inside = _compared(plate.grey, mean, spread, other, x, y, z)
            cost = torch.where(inside & (z > 0.1 * part[:, None, None]), cost, UNSEEN)
            second = torch.minimum(second, torch.maximum(cost, best))
            best = torch.minimum(cost, best)
        costs[..., CHUNK * k : CHUNK * k + len(part)] = (best if len(others) < 3 else (best + second) / 2).permute(1, 2, 0)
    return costs


def _compared(
    own: torch.Tensor, mean: torch.Tensor, spread: torch.Tensor, other: Plate, x: torch.Tensor, y: torch.Tensor, z: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """1 - correlation of grey levels `own`, of these moments, with what another plate shows at places `[N, rows, w]` before it, and whether
    these are in its view."""
    h, w = other.grey.shape
    behind = 1 / z.clamp_min(1e-3)
    u = (x * behind).mul_(2 * other.focal[0] / w).add_(2 * other.centre[0] / w - 1)
    v = (y * behind).mul_(2 * other.focal[1] / h).add_(2 * other.centre[1] / h - 1)
    grid = torch.stack([u, v], -1).clamp_(-3, 3)
    shown = F.grid_sample(other.grey[None, None].expand(len(grid), -1, -1, -1), grid, align_corners=False)[:, 0]
    their_mean, their_spread = _moments(shown)
    return 1 - (box_means(shown * own) - mean * their_mean) / (spread * their_spread), torch.maximum(u.abs(), v.abs()) < 1


def box_means(maps: torch.Tensor) -> torch.Tensor:
    """Means over squares of `WINDOW` of maps `[N, h, w]`."""
    half = WINDOW // 2
    for axis in (1, 2):
        size = maps.shape[axis]
        first, last = maps.narrow(axis, 0, 1), maps.narrow(axis, size - 1, 1)
        wide = torch.cat([*[first] * half, maps, *[last] * half], axis)
        maps = wide.narrow(axis, 0, size).clone()
        for shift in range(1, WINDOW):
            maps += wide.narrow(axis, shift, size)
    return maps.mul_(1 / WINDOW**2)


def _moments(maps: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Means and standard deviations over squares, the latter with noise."""
    mean = box_means(maps)
    return mean, (box_means(maps * maps) - mean * mean).clamp_min(0).add(FLAT * FLAT).sqrt()


def _pin(cost: torch.Tensor, plate: Plate, points: np.ndarray, step: float) -> None:
    """Make the pixels of known points expensive everywhere else; of several in one pixel the last counts."""
    row, column, z, inside = plate.shown(points)
    place = torch.from_numpy(1 / z[inside] / step).float()
    away = (torch.arange(PLANES) - place[:, None]).abs()
    # NumPy's, since torch's threads write in any order, and which point counts would be left to chance
    cost.numpy()[row[inside], column[inside]] += (PINNED * (away / 2).clamp_max(1.0)).numpy()


def _smoothed(cost: torch.Tensor, grey: torch.Tensor) -> torch.Tensor:
    """Costs `[h, w, D]` summed along paths from the left, right, top and bottom (Hirschmüller 2008, equation 13)."""
    total = torch.zeros_like(cost)
    for axis in (0, 1):
        lines, sums = cost.movedim(axis, 0), total.movedim(axis, 0)
        jumps = JUMP / (1 + grey.movedim(axis, 0).diff(dim=0).abs() / EDGE)
        for order, edges in ((range(len(lines)), jumps), (range(len(lines) - 1, -1, -1), jumps.flip(0))):
            path = torch.zeros_like(lines[0])
            # the first line has nothing before it: its jump costs nothing
            for i, jump in zip(order, [edges[0] * 0, *edges], strict=True):
                least = path.amin(1, keepdim=True)
                reach = torch.minimum(path, jump[:, None] + least)
                reach[:, 1:] = torch.minimum(reach[:, 1:], path[:, :-1] + NUDGE)
                reach[:, :-1] = torch.minimum(reach[:, :-1], path[:, 1:] + NUDGE)
                path = lines[i] + (reach - least)
                sums[i] += path
    return total


def unlike(plate: Plate, sides: Sequence[Sequence[tuple[Plate, np.ndarray]]], rows: slice, depth: float | torch.Tensor) -> torch.Tensor:
    """1 - correlation `[N, rows, w]` of a plate's rows, at a depth z or depths `[h, w]`, with others' where what they show has moved by any
    of N ways `[N, 3]` in the world; the mean of each side, of the better one, since the other may not see it."""
    own = plate.grey[None, rows]
    local = plate.rays()[rows].movedim(-1, 0) * (depth if isinstance(depth, float) else depth[rows])
    mean, spread = _moments(own)
    of_sides = []
    for side in sides:
        total = count = torch.zeros(())
        for other, ways in side:
            there = torch.from_numpy(other.cam_from_world @ np.linalg.inv(plate.cam_from_world)).float()
            moved = torch.from_numpy(ways @ other.cam_from_world[:3, :3].T).float() + there[:3, 3]
            x, y, z = (there[:3, :3] @ local.flatten(1)).reshape(local.shape)[:, None] + moved.T[:, :, None, None]
            cost, inside = _compared(own, mean, spread, other, x, y, z)
            seen = inside & (z > 0.5)
            total, count = total + torch.where(seen, cost, 0.0), count + seen
        of_sides.append(torch.where(count > 0, total / count.clamp_min(1), UNSEEN))
    return torch.stack(of_sides).amin(0)
