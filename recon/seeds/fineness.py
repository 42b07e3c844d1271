"""How finely a drive's cameras see what is somewhere: as dense as that, seeds show all pictures alike."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from scipy.spatial import cKDTree

from recon.ground import above_ground
from recon.views.project import project
from scenes.camera import RigCamera
from scenes.ground import Ground
from scenes.poses import inverse
from scenes.trajectory import Trajectory

CELL, APART, AWAY = 0.1, 0.2, 6.0
"""In distances to the path: sides of cells of which all is seen as one point is, steps of the path from which it
is looked at, and how far off."""

LYING = 0.15
"""Metres from the ground within which something lies on it, and is seen as aslant."""


def seen_from(xyz: np.ndarray, ground: Ground, ego: Trajectory, rig: Iterable[RigCamera], nearest: float) -> np.ndarray:
    """Metres `[N]` from which the sharpest camera, looking straight at it, would see what is at world points `[N, 3]` as finely as the rig
    does where it sees it best: what lies on the ground by the square root of the pixels on it, which the slant leaves fewer.

    Of what no camera sees, and at least, it is the distance to the path, up to `nearest` metres. A camera that looks ahead sees the road
    under its path from no nearer than where the picture ends.
    """
    path, cameras = ego.world_from_body[:, :3, 3].numpy(), list(rig)
    away = np.maximum(cKDTree(path).query(xyz)[0], nearest)
    levels = np.floor(np.log2(away)).astype(np.int64)
    found = np.empty(len(xyz))
    for level in np.unique(levels):
        of, scale = levels == level, 2.0**level
        cells = np.floor(xyz[of] / (CELL * scale)).astype(np.int64)
        _, first, which = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        best = _best(xyz[of][first], ground, _steps(ego, APART * scale, scale), cameras, AWAY * scale)
        found[of] = best[which.ravel()]
    return np.where(np.isfinite(found), np.maximum(found, away), away)


def _best(xyz: np.ndarray, ground: Ground, poses: torch.Tensor, cameras: list[RigCamera], reach: float) -> np.ndarray:
    """As `seen_from`, from bodies `[P, 4, 4]` within `reach` metres; inf of what none sees."""
    sharpest = max(camera.lens.focal()[0] for camera in cameras)
    tree, lies, best = cKDTree(xyz), np.abs(above_ground(xyz, ground)) < LYING, np.full(len(xyz), np.inf)
    for pose in poses:
        near = np.array(tree.query_ball_point(pose[:3, 3].numpy(), reach), dtype=np.int64)
        if not len(near):
            continue
        for camera in cameras:
            view = camera.at(pose, 0)
            _, _, depth, seen = project(xyz[near], inverse(view.world_from_cam).numpy(), view)
            eye = float(above_ground(view.world_from_cam[None, :3, 3].numpy(), ground)[0])
            slant = np.where(lies[near], np.maximum(depth / max(eye, LYING), 1.0) ** 0.5, 1.0)
            metres = depth * slant * (sharpest / camera.lens.focal()[0])
            best[near] = np.where(seen, np.minimum(best[near], metres), best[near])
    return best


def _steps(ego: Trajectory, metres: float, lever: float) -> torch.Tensor:
    """Poses `[P, 4, 4]` of a path, so many metres apart; a turn moves what is `lever` metres away."""
    poses = ego.world_from_body
    moved = (poses[1:, :3, 3] - poses[:-1, :3, 3]).norm(dim=1) + lever * (poses[1:, :3, :3] - poses[:-1, :3, :3]).norm(dim=(1, 2)) / 2**0.5
    step = torch.cat([torch.zeros(1, dtype=moved.dtype), (moved.cumsum(0) / metres).floor()])
    return poses[torch.cat([torch.ones(1, dtype=torch.bool), step[1:] > step[:-1]])]
