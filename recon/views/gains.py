"""Pictures of different exposure brought to one: a gain a picture and channel, from the points that several pictures show.

Gain compensation after Brown and Lowe (2007, section 6), by medians: a point's colour in a picture is its own colour times the
picture's gain. Photos are exposed one by one, and so are the frames of a camera that follows the light of a street (`gains_along`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch.nn import functional as F

from recon.views.project import project
from scenes.camera import Camera
from scenes.poses import inverse

FEWEST = 20
"""Shared points that a gain needs; a picture with fewer keeps 1."""

DARK, BRIGHT = 0.06, 0.92
"""Colours outside say nothing about exposure: noise and clipping."""

CLIPPED = 0.98
"""Colours of pixels from which on they may be clipped."""

APART = (1, 2, 4, 8, 16)
"""Frames apart that are compared with one another: neighbours show the most of the same, and far ones keep errors from adding up."""

ACROSS = 240
"""Cells across a frame, over which its pixels are averaged: a point's own pixel is at an edge as likely as not."""


def picture_gains(colours: Sequence[np.ndarray], points: Sequence[np.ndarray], count: int) -> np.ndarray:
    """Gains `[F, 3]`, geometric mean 1, of pictures whose `points[f]` `[P]` (of `count`) have `colours[f]` `[P, 3]` in 0..1."""
    logs = np.full((len(colours), 3), 0.0)
    usable = [(c > DARK).all(1) & (c < BRIGHT).all(1) for c in colours]
    kept = [(np.log(c[u]), p[u]) for c, p, u in zip(colours, points, usable, strict=True)]
    seen = np.bincount(np.concatenate([p for _, p in kept]), minlength=count) if kept else np.zeros(count)
    kept = [(c[seen[p] > 1], p[seen[p] > 1]) for c, p in kept]
    for _ in range(30):
        total, number = np.zeros((count, 3)), np.zeros(count)
        for gain, (colour, shown) in zip(logs, kept, strict=True):
            np.add.at(total, shown, colour - gain)
            np.add.at(number, shown, 1)
        own = total / np.maximum(number, 1)[:, None]
        logs = np.array([np.median(c - own[p], axis=0) if len(p) >= FEWEST else np.zeros(3) for c, p in kept])
        logs -= logs.mean(0)
    return np.exp(logs)


def gains_along(images: Sequence[torch.Tensor], cameras: Sequence[Camera], points: Sequence[np.ndarray]) -> np.ndarray:
    """Gains `[F, 3]`, geometric mean 1, of a camera's frames in the order of time; NaN of those that show nothing that others show.

    images: uint8 `[H, W, 3]`; cameras: theirs, of any size; points: world points `[N, 3]` that lidar measured about each frame's moment.
    Those of one frame are looked up in others too; what moved or is hidden there is outvoted. Their ratios are met by least squares.
    """
    height, width = (max(1, round(n * ACROSS / images[0].shape[1])) for n in images[0].shape[:2])
    small = [_cells(image, height, width) for image in images]
    seen = [camera.resized(width, height) for camera in cameras]
    count = len(images)
    normal, wanted = 1e-6 * np.eye(count), np.zeros((count, 3))
    for a in range(count):
        here, there = _shown(points[a], seen[a], small[a])
        for b in {k for step in APART for k in (a - step, a + step) if 0 <= k < count}:
            other, as_well = _shown(points[a], seen[b], small[b])
            both = there & as_well & _tells(here) & _tells(other)
            if both.sum() >= FEWEST:
                ratio = np.median(np.log(other[both]) - np.log(here[both]), axis=0)
                weight = np.sqrt(both.sum())
                normal[[a, b], [a, b]] += weight
                normal[[a, b], [b, a]] -= weight
                wanted[b] += weight * ratio
                wanted[a] -= weight * ratio
    logs = np.linalg.solve(normal, wanted)
    logs[np.diag(normal) < 1e-3] = np.nan
    return np.exp(logs - np.nanmean(logs, axis=0)) if np.isfinite(logs).any() else logs


def _cells(image: torch.Tensor, height: int, width: int) -> np.ndarray:
    """A uint8 image's means over cells `[height, width, 3]` in 0..1; NaN where a pixel of one may be clipped."""
    planes = image.permute(2, 0, 1)[None].float() / 255
    clipped = F.adaptive_max_pool2d(planes, (height, width)) > CLIPPED
    cells = F.interpolate(planes, (height, width), mode="area")
    return torch.where(clipped, torch.nan, cells)[0].permute(1, 2, 0).numpy()


def _shown(points: np.ndarray, camera: Camera, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours `[N, 3]` of points in a camera's image, and which lie in it."""
    row, column, _, inside = project(points, inverse(camera.world_from_cam).numpy(), camera)
    return image[row, column], inside


def _tells(colour: np.ndarray) -> np.ndarray:
    return np.all((colour > DARK) & (colour < BRIGHT), axis=1)
