"""Seeds where there is no lidar: the few points of structure from motion, spread over the pictures that show them."""

from __future__ import annotations

import numpy as np
import torch
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError

from recon.frames import Frames, View
from recon.log import Log, SparsePoints, Track
from recon.seed import Cloud, nearest_box, spread
from scenes.camera import Camera
from scenes.poses import inverse

STEP = 6
"""Pixels between seeds: between the points of a picture its depth is interpolated."""

VIEWS = 40
"""Pictures a camera that seeds are taken from, at most."""

FEWEST = 8
"""Points that a picture must show before a surface is drawn through them."""


def cloud_from_points(log: Log, frames: Frames, sparse: SparsePoints, movers: list[Track]) -> Cloud:
    """Seeds `[N, 3]` from training pictures: each one's points and a grid of pixels between them, at the depth that is interpolated.

    Inverse depth is linear in the image across a plane, so it is what is interpolated, over the Delaunay triangles of the points.
    Sky stays empty, and what the boxes of `movers` may hide. ValueError where no picture shows enough points.
    """
    parts: list[Cloud] = []
    for c, name in enumerate(frames.names):
        for view in spread(frames.of(c), VIEWS):
            camera = log.camera(name).camera(view.index, frames.width, frames.height)
            made = _of_view(view, camera, sparse.xyz[sparse.seen[name][view.index]], movers)
            if made is not None:
                parts.append(made)
    if not parts:
        raise ValueError(f"{log.path}: no training picture shows {FEWEST} points; match more pictures, or take other cameras")
    return Cloud(np.concatenate([p.xyz for p in parts]), np.concatenate([p.rgb for p in parts]))


def _of_view(view: View, camera: Camera, points: np.ndarray, movers: list[Track]) -> Cloud | None:
    back = inverse(camera.world_from_cam).numpy()
    local = points @ back[:3, :3].T + back[:3, 3]
    local = local[(local[:, 2] > 0.1) & camera.lens.valid(torch.from_numpy(local)).numpy()]
    if len(local) < FEWEST:
        return None
    pixels = camera.lens.project(torch.from_numpy(local)).numpy()
    depth = camera.lens.depth(torch.from_numpy(local)).numpy()
    rows, columns = np.mgrid[STEP // 2 : camera.height : STEP, STEP // 2 : camera.width : STEP]
    grid = np.stack([columns.ravel(), rows.ravel()], 1) + 0.5
    try:
        inverse_depth = LinearNDInterpolator(pixels, 1 / depth)(grid)
    except QhullError:  # all in one line
        return None
    at = np.concatenate([grid, pixels])
    z = np.concatenate([1 / inverse_depth, depth])
    column, row = np.floor(at).astype(np.int64).T
    inside = np.isfinite(z) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    column, row, at, z = column[inside], row[inside], at[inside], z[inside]
    step = np.array(view.image.shape[:2]) / view.sky.shape
    clear = ~view.sky.numpy()[(row / step[0]).astype(np.int64), (column / step[1]).astype(np.int64)]
    clear &= z < nearest_box(camera, movers)[row, column]
    column, row, at, z = column[clear], row[clear], at[clear], z[clear]
    pose = camera.world_from_cam.numpy()
    xyz = (camera.lens.unproject(torch.from_numpy(at)).numpy() * z[:, None]) @ pose[:3, :3].T + pose[:3, 3]
    return Cloud(xyz, view.image.numpy()[row, column] / 255)
