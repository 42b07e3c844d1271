"""The ground under a drive as a height field, from the lowest lidar points and the body's own path."""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage

from scenes.ground import Ground
from scenes.trajectory import Trajectory

CELL = 0.5
REACH = 60.0
"""Metres around the path that the height field covers."""


def estimate_ground(points: np.ndarray, ego: Trajectory) -> Ground:
    """Height field from static points `[N, 3]` and the body's path.

    A cell's height is the 5th percentile of its points; cells that stand more than 0.3 m above the median of the 5 m around
    them (cars, walls) are dropped, and the gaps filled from ever wider averages. Without points the ground is flat under the body.
    """
    path = ego.world_from_body[:, :3, 3].numpy()
    low, high = path[:, :2].min(0) - REACH, path[:, :2].max(0) + REACH
    shape = tuple(int(n) for n in np.ceil((high - low) / CELL)[::-1] + 1)
    heights = np.full(shape, np.nan)
    near = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(1) & (np.abs(points[:, 2] - np.median(path[:, 2])) < 4)
    points = points[near]
    if len(points):
        column, row = np.round((points[:, :2] - low) / CELL).astype(np.int64).clip(0, np.array(shape[::-1]) - 1).T
        order = np.lexsort((points[:, 2], row * shape[1] + column))
        cells, first, counts = np.unique((row * shape[1] + column)[order], return_index=True, return_counts=True)
        heights.flat[cells] = points[order, 2][first + (counts * 0.05).astype(np.int64)]
    heights = _without_objects(heights, path, low)
    return Ground(torch.from_numpy(_filled(heights, float(np.median(path[:, 2])))).float(), (float(low[0]), float(low[1])), CELL)


def _without_objects(heights: np.ndarray, path: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Drop cells that are not road or pavement: grow outward from the path, allowing the slope of a street."""
    column, row = np.round((path[:, :2] - low) / CELL).astype(np.int64).T
    on_path = np.zeros(heights.shape, dtype=bool)
    on_path[row, column] = True
    close = ndimage.binary_dilation(on_path, iterations=int(4 / CELL)) & np.isfinite(heights)
    base = float(np.percentile(heights[close], 30)) if close.any() else float(np.nanmedian(heights)) if np.isfinite(heights).any() else 0.0
    distance = ndimage.distance_transform_edt(~on_path) * CELL
    plausible = np.isfinite(heights) & (np.abs(heights - base) < 0.4 + 0.04 * distance)
    smooth = _filled(np.where(plausible, heights, np.nan), base, start=2.5)
    return np.where(plausible & (np.abs(heights - smooth) < 0.3), heights, np.nan)


def _filled(heights: np.ndarray, default: float, start: float = 0.7) -> np.ndarray:
    """Gaps (and noise) filled by averages of known cells over 0.7 m, 1.4 m, ... 12 m, and beyond by the nearest filled cell."""
    known = np.isfinite(heights)
    if not known.any():
        return np.full(heights.shape, default)
    values, out = np.where(known, heights, 0.0).astype(np.float32), np.full(heights.shape, np.nan)
    sigma = start / CELL
    while np.isnan(out).any() and sigma < 24:
        weight = ndimage.gaussian_filter(known.astype(np.float32), sigma, mode="nearest", truncate=3)
        mean = ndimage.gaussian_filter(values, sigma, mode="nearest", truncate=3) / np.maximum(weight, 1e-9)
        take = np.isnan(out) & (weight > 0.05)
        out[take] = mean[take]
        sigma *= 2
    nearest = ndimage.distance_transform_edt(np.isnan(out), return_distances=False, return_indices=True)
    return out[tuple(nearest)]
