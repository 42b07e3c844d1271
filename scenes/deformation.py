"""How what bends moves within its own frame: lattices of displacements, and few of them weighted over time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F

from scenes.checks import check_tensor
from scenes.trajectory import between

RETURNS = 8
"""Steps towards where a point stood before a lattice moved it: each leaves what the displacement changes over its own length."""


@dataclass(frozen=True)
class Lattice:
    """Displacements in a local frame: free-form deformation (Sederberg and Parry 1986), linear between nodes and held beyond them.

    corners float32 `[2, 3]`: the first and the last node, metres; nodes float32 `[X, Y, Z, 3]`: how far each moves, metres; at least two
    nodes along each axis. What stands together moves together, whichever splats they are.
    """

    corners: torch.Tensor
    nodes: torch.Tensor

    def __post_init__(self):
        _check_corners(self.corners)
        check_tensor("nodes", self.nodes, ("X", "Y", "Z", 3), torch.float32)
        _check_counts("nodes", self.nodes.shape[:3])

    def at(self, points: torch.Tensor) -> torch.Tensor:
        """How far points `[N, 3]` move, `[N, 3]`. Differentiable in the nodes; where the points are counts as given."""
        low, high = self.corners.to(points, non_blocking=True)  # the host need not wait for what it has said
        places = (2 * (points.detach() - low) / (high - low) - 1).flip(-1)  # grid_sample's first coordinate is that of the last axis
        if points.device.type == "cuda" and self.nodes.requires_grad:
            return self._by_hats(places.flip(-1))
        grid = self.nodes.to(points).permute(3, 0, 1, 2)[None]
        return F.grid_sample(grid, places[None, None, None], align_corners=True, padding_mode="border")[0, :, 0, 0].T

    def _by_hats(self, places: torch.Tensor) -> torch.Tensor:
        """The same at places `[N, 3]`, -1 to 1 between the corners, as one product of matrices: where points share a node, a GPU would add
        up their gradients in any order."""
        nodes, hats = self.nodes, []
        for count, along in zip(nodes.shape[:3], places.unbind(-1), strict=True):
            at = (0.5 * (along + 1) * (count - 1)).clamp(0, count - 1)
            hats.append((1 - (at[:, None] - torch.arange(count, device=at.device)).abs()).clamp_min(0))
        x, y, z = hats
        weights = (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).flatten(1)
        return weights @ nodes.flatten(0, 2)

    @torch.no_grad()
    def origin(self, points: torch.Tensor) -> torch.Tensor:
        """Where points `[N, 3]` stood before they were moved: `x + at(x) = points`, by fixed-point iteration."""
        before = points
        for _ in range(RETURNS):
            before = points - self.at(before)
        return before


@dataclass(frozen=True)
class Deformation:
    """How an actor deforms over time, in its own frame: the lattice `sum over b of weights[t, b] modes[b]`.

    That few modes, weighted over time, carry a body's motion is the basis of non-rigid structure from motion (Bregler et al. 2000); of
    people who walk four hold 98 % (Troje 2002).

    corners as of `Lattice`; modes float32 `[B, X, Y, Z, 3]` metres; times_us int64 `[T]`, rising strictly; weights float32 `[T, B]`: linear
    between the times, as USD has it between samples, and held beyond.
    """

    corners: torch.Tensor
    modes: torch.Tensor
    times_us: torch.Tensor
    weights: torch.Tensor

    def __post_init__(self):
        _check_corners(self.corners)
        check_tensor("modes", self.modes, ("B", "X", "Y", "Z", 3), torch.float32)
        _check_counts("modes", self.modes.shape[1:4])
        check_tensor("times_us", self.times_us, ("T",), torch.int64)
        check_tensor("weights", self.weights, (len(self.times_us), len(self.modes)), torch.float32)
        if not len(self.times_us):
            raise ValueError("a deformation must have at least one time, got none")
        if not (self.times_us.diff() > 0).all():
            raise ValueError(f"times_us must rise strictly, but entry {int((self.times_us.diff() <= 0).nonzero()[0]) + 1} does not")

    def validate(self, where: str) -> None:
        """Raise ValueError where a number is not finite."""
        for name in ("corners", "modes", "weights"):
            if not torch.isfinite(getattr(self, name)).all():
                raise ValueError(f"{where}: its deformation has {name} that are not finite")

    def at(self, time_us: int) -> Lattice:
        """The lattice at a time."""
        return Lattice(self.corners, torch.tensordot(between(self.times_us, self.weights, time_us), self.modes, 1))

    def later(self, by_us: int) -> Deformation:
        """The same, everything `by_us` microseconds later."""
        return replace(self, times_us=self.times_us + by_us)

    def to(self, device) -> Deformation:
        """With its lattices on a device; corners and times stay where they are."""
        return replace(self, modes=self.modes.to(device), weights=self.weights.to(device))


def _check_corners(corners: torch.Tensor) -> None:
    check_tensor("corners", corners, (2, 3), torch.float32)
    if not (corners[1] > corners[0]).all():
        raise ValueError(f"corners must be the least and the largest, got {corners.tolist()}")


def _check_counts(name: str, counts) -> None:
    if min(counts) < 2:
        raise ValueError(f"{name} must have at least 2 nodes along each axis, got {tuple(counts)}")
