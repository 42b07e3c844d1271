"""Where a picture shows points."""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage

from scenes.camera import Camera
from scenes.poses import inverse

NEAREST = 0.3
"""Metres before the camera from which on it shows anything."""


def project(points: np.ndarray, cam_from_local: np.ndarray, cam: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Row, column (int64), depth as the lens means it and whether in view, `[N]` each, of points `[N, 3]`.

    Row and column are 0 where not in view.
    """
    local = torch.from_numpy(points @ cam_from_local[:3, :3].T + cam_from_local[:3, 3])
    before = ((local[:, 2] > NEAREST) & cam.lens.valid(local)).numpy()
    column, row = np.zeros((2, len(points)))
    column[before], row[before] = np.floor(cam.lens.project(local[before]).numpy()).T
    seen = before & (column >= 0) & (column < cam.width) & (row >= 0) & (row < cam.height)
    return np.where(seen, row, 0).astype(np.int64), np.where(seen, column, 0).astype(np.int64), cam.lens.depth(local).numpy(), seen


def nearest_around(points: np.ndarray, camera: Camera, pixels: int) -> np.ndarray:
    """The least depth `[H, W]` that any of world points `[N, 3]` has within so many pixels up, down, left and right; infinite at none."""
    row, column, z, seen = project(points, inverse(camera.world_from_cam).numpy(), camera)
    nearest = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(nearest, (row[seen], column[seen]), z[seen])
    return ndimage.minimum_filter(nearest, 2 * pixels + 1, mode="nearest")
