"""What lidar does not reach: splats for pixels that neither it nor the sky explains.

Lidar sees about 15 degrees up and loses dark and shiny things. Buildings above it, wires, far blocks and windows get splats at
the depth of what stands below them in the image, since facades and poles are upright.
"""

from __future__ import annotations

import warnings

import numpy as np
import torch
from scipy import ndimage

from recon.seeds.points import Cloud
from recon.seeds.sweep import swept_depth
from recon.view import View
from scenes.camera import Camera

FAR = 250.0
"""Metres to things with nothing below them that lidar reaches."""

STEP = 6
"""Pixels between filling splats."""


def unexplained(
    view: View, camera: Camera, alpha: np.ndarray, depth: np.ndarray, sky: np.ndarray, gain: np.ndarray, floor: float,
    others: list[tuple[View, Camera]],
) -> tuple[Cloud, np.ndarray]:  # fmt: skip
    """World points with colours for pixels that neither splats (`alpha` `[H, W]`) nor sky explain, and their widths in metres.

    One a `STEP` x `STEP` block, at the depth (`depth` `[H, W]`, z) of the nearest explained pixel below in the column, or `FAR`, or
    farther where the `others`, views from elsewhere, say so; never under the ground at height `floor`.
    """
    half = STEP // 2
    rows, columns = np.mgrid[half : camera.height : STEP, half : camera.width : STEP]
    solid = ndimage.uniform_filter((alpha > 0.5).astype(np.float32), STEP)[rows, columns] > 0.3
    blocked = ndimage.uniform_filter(sky.astype(np.float32), STEP)[rows, columns] > 0.5
    z = _from_below(np.where(solid, depth[rows, columns], np.nan))
    want = ~solid & ~blocked
    pixels = torch.from_numpy(np.stack([columns[want], rows[want]], 1) + 0.5)
    z = swept_depth(pixels, z[want], STEP / 3, view, camera, others)
    rays = camera.lens.unproject(pixels).numpy()
    pose = camera.world_from_cam.numpy()
    down = np.minimum(rays @ pose[2, :3], -1e-3)
    z = np.minimum(z, np.maximum(0.5, (floor - pose[2, 3]) / down))
    local = rays * z[:, None]
    colour = ndimage.uniform_filter(view.evenly(), (STEP, STEP, 1))[rows[want], columns[want]] / gain
    return Cloud(local @ pose[:3, :3].T + pose[:3, 3], colour), z * STEP / camera.lens.focal()[0]


def _from_below(depth: np.ndarray) -> np.ndarray:
    """Gaps (NaN) take the depth of the nearest known cell below in their column, else beside, else `FAR`."""
    known = np.isfinite(depth)
    rows = np.arange(len(depth))[:, None]
    below = np.where(known, rows, len(depth))
    below = np.minimum.accumulate(below[::-1], 0)[::-1]
    filled = np.where(below < len(depth), np.take_along_axis(depth, np.minimum(below, len(depth) - 1), 0), np.nan)
    # a single near lidar hit (a wire, a lamp) must not pull a whole column to it: the median of the columns around decides
    beside = np.lib.stride_tricks.sliding_window_view(np.pad(filled, ((0, 0), (2, 2)), mode="edge"), 5, axis=1)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # where nothing is known there is no median
        filled = np.where(known, depth, np.nanmedian(beside, axis=2))
    return np.where(np.isfinite(filled), filled, FAR)
