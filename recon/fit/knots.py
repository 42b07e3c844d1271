"""Small corrections of a trajectory's poses, and how they lie between its knots."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from scenes.poses import interpolate, small_poses
from scenes.trajectory import Trajectory


def scaled(raw: torch.Tensor, radians: float, metres: float) -> torch.Tensor:
    """A correction `[..., 6]` in its units as radians and metres."""
    return raw * raw.new_tensor([radians] * 3 + [metres] * 3)


def _between(times_us: np.ndarray, at_us: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """For each moment the index of the earlier neighbour and the share of the later one; beyond 0..1 outside."""
    if len(times_us) == 1:
        return torch.zeros(len(at_us), dtype=torch.long), torch.zeros(len(at_us), dtype=torch.float64)
    k = np.searchsorted(times_us, at_us).clip(1, len(times_us) - 1) - 1
    return torch.from_numpy(k), torch.from_numpy((at_us - times_us[k]) / (times_us[k + 1] - times_us[k]))


class Knots:
    """A trajectory with small corrections `[K, 6]` in the body's own frame at some of its times, the knots; between them linear.

    Poses that nothing trains, those of held-out frames, are no knots: their neighbours' corrections carry them.
    """

    def __init__(self, trajectory: Trajectory, knots_us: torch.Tensor | None = None):
        self.trajectory = trajectory
        self.knots_us = trajectory.times_us if knots_us is None else knots_us
        self.deltas = torch.zeros(len(self.knots_us), 6)

    def base(self, times_us: np.ndarray) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Uncorrected poses `[V, 4, 4]` at times, and for each the earlier knot and the share of the later one."""
        k, u = _between(self.trajectory.times_us.numpy(), times_us)
        poses = self.trajectory.world_from_body
        knot, share = _between(self.knots_us.numpy(), times_us)
        # corrections are held, not extrapolated, beyond the first and last knot
        return interpolate(poses[k], poses[(k + 1).clamp_max(len(poses) - 1)], u), knot, share.clamp(0, 1)

    def correction(self, knot: torch.Tensor, share: torch.Tensor) -> torch.Tensor:
        """Small motions `[..., 6]` between knots; differentiable in `deltas`."""
        after = (knot + 1).clamp_max(len(self.deltas) - 1)
        share = share.to(self.deltas)[..., None]
        return self.deltas[knot] * (1 - share) + self.deltas[after] * share

    def corrected(self, radians: float, metres: float) -> Trajectory:
        """The trajectory with its corrections, in these units, applied."""
        _, knot, share = self.base(self.trajectory.times_us.numpy())
        deltas = scaled(self.correction(knot, share).detach(), radians, metres)
        return replace(self.trajectory, world_from_body=self.trajectory.world_from_body @ small_poses(deltas))

    def unrest(self) -> torch.Tensor:
        """Sum of squared second differences of the corrections: bodies do not shake."""
        d = self.deltas
        return (d[2:] - 2 * d[1:-1] + d[:-2]).square().sum() if len(d) > 2 else d.sum() * 0
