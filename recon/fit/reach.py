"""How finely cameras see what is somewhere: what 1000 pixels of the sharpest span there, by which steps and limits of splats scale."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree

from recon.fit.densify import LARGEST
from recon.seeds.measured import Measured, nearer
from scenes.camera import RigCamera
from scenes.gaussians import Gaussians
from scenes.trajectory import Trajectory

NEAREST, NEAR = 3.0, 0.1
"""Metres from the path within which nothing is seen sharper: the long lens looks ahead, and only wide ones see what is beside the car.
Where a robot's pictures show more than this part of what they show from nearer, that near."""

WIDER, THERE = 1.5, 0.01
"""Times as wide as it is seeded that a splat may become which no picture shows, and metres from such a seed's point that are there."""


def nearest_of(measured: Sequence[Measured]) -> float:
    """Metres from the path within which nothing is seen sharper, by the depths in pictures."""
    return min(NEAREST, nearer(measured, NEAR))


def spanned(rig: Iterable[RigCamera]) -> float:
    """Metres that 1000 pixels of the sharpest camera span a metre away."""
    return 1000 / max(camera.lens.focal()[0] for camera in rig)


def reach_at(xyz: np.ndarray, ego: Trajectory, rig: Iterable[RigCamera], nearest: float) -> np.ndarray:
    """Metres `[N]` that they span at world points `[N, 3]`, from where the path comes nearest to each, up to `nearest` metres."""
    away, _ = cKDTree(ego.world_from_body[:, :3, 3].numpy()).query(xyz)
    return spanned(rig) * np.maximum(away, nearest)


def reach_of(splats: Gaussians, ego: Trajectory, rig: Iterable[RigCamera], nearest: float) -> torch.Tensor:
    """The same float32 `[N]` of splats of the background, or as much more as suits those that are wider than cameras can tell: ground that
    none of them saw must not be cut down to leave gaps."""
    reach = torch.from_numpy(reach_at(splats.means.numpy(), ego, rig, nearest)).float()
    return torch.maximum(reach, splats.log_scales.exp().amax(1) / LARGEST)


def held_back(reach: torch.Tensor, splats: Gaussians, hidden: np.ndarray) -> torch.Tensor:
    """The reach `[N]` of splats, less of those that stand at `hidden` points `[M, 3]`, which no picture shows: they are as wide as lidar's
    points there are apart. Views from aside, which ask that gaps be closed, are all that pulls at them, and Adam's steps are as long
    however small a gap is: they swelled until a few blurs stood for a parked car."""
    if not len(hidden):
        return reach
    away, _ = cKDTree(hidden).query(splats.means.numpy())
    narrow = WIDER * splats.log_scales.exp().amax(1) / LARGEST
    return torch.where(torch.from_numpy(away < THERE), torch.minimum(reach, narrow), reach)
