"""Where a picture shows points."""

from __future__ import annotations

import numpy as np
import torch

from scenes.camera import Camera

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
