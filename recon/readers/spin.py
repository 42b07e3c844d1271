"""Sweeps of a spinning lidar: every point was taken from where the lidar stood at that moment, not at the sweep's stamp."""

from __future__ import annotations

import numpy as np
import torch

from scenes.trajectory import Trajectory

STEPS = 64
"""Poses of the lidar in a turn; between them it goes straight on. 6 degrees at 30 m/s are 5 cm, interpolated."""


def untwisted(xyz: np.ndarray, times_us: np.ndarray, body_from_lidar: torch.Tensor, ego: Trajectory) -> np.ndarray:
    """World points `[N, 3]` of points `[N, 3]` in the lidar's frame, each taken at its own time `[N]` (int64 us)."""
    if not len(xyz):
        return np.zeros((0, 3))
    knots = np.unique(np.linspace(times_us.min(), times_us.max(), STEPS + 1).round().astype(np.int64))
    poses = (ego.near_each(torch.from_numpy(knots)) @ body_from_lidar).numpy()
    left = (np.searchsorted(knots, times_us, side="right") - 1).clip(0, max(len(knots) - 2, 0))
    right = np.minimum(left + 1, len(knots) - 1)
    share = ((times_us - knots[left]) / np.maximum(knots[right] - knots[left], 1))[:, None]
    return (1 - share) * _moved(poses[left], xyz) + share * _moved(poses[right], xyz)


def _moved(poses: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", poses[:, :3, :3], xyz) + poses[:, :3, 3]
