"""Holes in a vehicle's sides: where something stood before it in all photos, or where too few showed it, light passes.

What is seen of a side tells where its surface is; a hole is closed on a surface that runs smoothly through what is around, a little deeper,
so that it shows through holes only, in the colours around it. What is mirrored (`extract.completed`) has the holes of the side that was
seen, so both are closed alike. A guess, whose area is kept (`meta["patched_m2"]`).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree

from recon.objects.mirror import SOLID
from recon.objects.outline import CLEARANCE
from recon.seeds.points import Cloud, splats_from
from render import Frame, rasterize
from scenes.camera import Camera
from scenes.gaussians import Gaussians
from scenes.harmonics import rgb_from_sh
from scenes.lenses import Orthographic

STEP = 0.05
"""Metres between the splats that close something."""

OPAQUE = 0.8
"""Alpha from which on there is no hole."""

PIXEL = 0.02
"""Metres of a pixel in which holes are looked for."""

ALIKE = 48
"""Nearest splats whose median colour a splat gets; what differs in height counts `LEVEL` times as far."""
LEVEL = 3.0

SMALL = 0.01
"""Square metres below which a hole is left as it is: paint seen through the edge of a splat."""

GAP = 0.24
"""Metres to which the outline of a side may be open where a hole meets it."""

SMOOTH = 0.1
"""Metres over which a surface is taken through what is around a hole, at least; as much more as the hole is wide."""

DEEPER = 0.03
"""Metres that what closes a side lies behind its surface."""

SIDES = (1.0, -1.0)
"""Where the left and the right side are along y."""


def patched(splats: Gaussians, size: np.ndarray) -> tuple[Gaussians, float]:
    """Splats that close the holes of both sides of those in a box `[length, width, height]`, and the holes' area, m^2."""
    patches = [_patch(splats, size, side) for side in SIDES]
    return Gaussians.cat([patch for patch, _ in patches]), sum(area for _, area in patches)


def _patch(splats: Gaussians, size: np.ndarray, side: float) -> tuple[Gaussians, float]:
    camera, frame = shown_alone(splats, size, 1, side)
    assert frame.alpha is not None and frame.median_depth is not None
    alpha, depth = frame.alpha.numpy(), frame.median_depth.numpy()
    high, long = alpha.shape
    rows = (high - np.arange(high) - 0.5) * PIXEL  # heights
    holes = _holes(alpha >= OPAQUE, rows > CLEARANCE)
    if not holes.any():
        return Gaussians.empty(splats.sh.shape[1]), 0.0
    every = round(STEP / PIXEL)
    at = np.zeros_like(holes)
    at[every // 2 :: every, every // 2 :: every] = True
    at &= ndimage.maximum_filter(holes, every)  # up to its edge
    surface = _through(np.where(np.isfinite(depth), depth, 0.0), (alpha >= OPAQUE) & np.isfinite(depth), at)
    row, column = np.nonzero(at)
    y = side * (size[1] - surface[row, column] - DEEPER)
    points = np.stack([side * (long / 2 - column - 0.5) * PIXEL, y, rows[row]], 1)
    half = splats.select((torch.sigmoid(splats.logit_opacities) > SOLID) & (splats.means[:, 1] * side > 0))
    return in_colours_of(half, points, half.means.double().numpy(), points), float(holes.sum()) * PIXEL**2


def _holes(solid: np.ndarray, clear: np.ndarray) -> np.ndarray:
    """Mask `[rows, columns]` of what is not solid within a side's outline, in the rows that are `clear` of the ground."""
    reach = round(GAP / PIXEL / 2)
    frame = np.pad(solid & clear[:, None], 2 * reach)  # so that the picture's border does not count as a part of the side
    outline = ndimage.binary_closing(frame, iterations=reach)[2 * reach : -2 * reach, 2 * reach : -2 * reach]
    # between its ends a side goes down to there, and what is below an end that rises stays open to the outside
    columns = np.flatnonzero((solid & clear[:, None]).sum(0) * PIXEL > GAP)
    if not len(columns):
        return np.zeros_like(solid)
    bounded = outline.copy()
    bounded[~clear, columns[0] : columns[-1] + 1] = True
    holes = ndimage.binary_fill_holes(bounded) & ~solid & clear[:, None]
    label, count = ndimage.label(holes)
    area = np.bincount(label.ravel(), minlength=count + 1) * PIXEL**2
    area[0] = 0.0
    return area[label] >= SMALL


def _through(depth: np.ndarray, known: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Depths `[rows, columns]` where `at` says by those known around: weighted by a Gaussian that is as wide as the way to the next."""
    out = np.zeros_like(depth)
    todo, width = at.copy(), SMOOTH / PIXEL
    away = ndimage.distance_transform_edt(~known)
    while todo.any():
        weight = ndimage.gaussian_filter(known.astype(float), width)
        value = ndimage.gaussian_filter(np.where(known, depth, 0.0), width)
        now = todo & ((away <= width) | (width > max(depth.shape))) & (weight > 0)
        out[now] = value[now] / weight[now]
        todo &= ~now
        width *= 2
    return out


def shown_alone(splats: Gaussians, size: np.ndarray, axis: int, end: float) -> tuple[Camera, Frame]:
    """The half of a vehicle in a box `[length, width, height]` at its front or rear (axis 0, `end` 1 or -1) or its left or right (axis 1),
    seen from there along that axis: alpha and median depth, from as far outside of the middle as the box is long or wide."""
    half = splats.select(splats.means[:, axis] * end > 0)
    columns, rows = (math.ceil(metres / PIXEL) for metres in (size[1 - axis], size[2]))
    pose = torch.eye(4, dtype=torch.float64)
    right = [0.0, end, 0.0] if axis == 0 else [-end, 0.0, 0.0]
    ahead = [-end, 0.0, 0.0] if axis == 0 else [0.0, -end, 0.0]
    pose[:3, :3] = torch.tensor([right, [0.0, 0.0, -1.0], ahead], dtype=torch.float64).T
    pose[axis, 3] = end * size[axis]
    camera = Camera(Orthographic(1 / PIXEL, 1 / PIXEL, columns / 2, float(rows)), columns, rows, pose)
    with torch.no_grad():
        frame = rasterize(half, camera, ("alpha", "median_depth"))
    assert isinstance(frame, Frame)
    return camera, frame


def in_colours_of(solid: Gaussians, places: np.ndarray, points: np.ndarray, like: np.ndarray) -> Gaussians:
    """Splats at `places` `[M, 3]`, of one colour from all sides: the median of those `solid` whose points `[N, 3]` are nearest to `like`
    `[M, 3]`."""
    if not len(places) or not len(points):
        return Gaussians.empty(solid.sh.shape[1])
    nearest = cKDTree(points * [1, 1, LEVEL]).query(like * [1, 1, LEVEL], k=min(ALIKE, len(points)))[1]
    colours = np.median(rgb_from_sh(solid.sh[:, 0]).numpy()[nearest.reshape(len(places), -1)], axis=1)
    return splats_from(Cloud(places, colours), np.full(len(places), STEP), solid.sh.shape[1], STEP)
