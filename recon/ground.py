"""The ground under a drive as a height field, from the lowest lidar points and the body's own path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage

from scenes.ground import Ground
from scenes.trajectory import Trajectory

CELL = 0.5
REACH = 60.0
"""Metres around the path that the height field covers."""

CLOSE = 4.0
"""Metres from the path within which the ground is as far below it as everywhere else."""

MOST = 4_000_000
"""Cells of a height field: of a drive across more than a kilometre each way they are larger."""

RING = 2.0
"""Metres by which what is known to be ground grows outwards at a time."""

STEP = 0.4
"""Metres that ground may be off what the ground around leads one to expect: kerbs and steep streets are, cars are not."""

NOISE, TELLING = 0.1, 4
"""Metres that lidar's points of the ground are off it at most, by their noise and that of poses, and how many of a cell tell its height."""

GROUND, BARE = 1, 2
"""What is known of a cell (`shown_ground`)."""

LEAST, MOST_OFF = 0.15, 1.5
"""Metres off the ground between which nothing is above it where it is bare, and below it where it is known: at a step it is neither."""

STRAY, STRAY_IN_PICTURES = 0.02, 0.3
"""How many points are there all the same, in parts of those that lie on it: of lidar's, and of those on which pictures agree, which are a
decimetre off a road."""

ALONG, LEVELS = 2.0, 20.0
"""Metres of the path by which its steepness is told; and how far it goes on beyond the path's ends."""

STEEPEST = 0.2
"""Metres by which ground may rise or fall with every metre away from the path."""


def estimate_ground(points: np.ndarray, ego: Trajectory) -> Ground:
    """Height field from static points `[N, 3]` and the body's path, uphill and down.

    A cell's height is the 5th percentile of its points, and in the end as much more as makes it the mean of those that lie on it. Ground is
    what lies below the path as most of the road does, and what goes on from there without a step, outwards ring by ring; cells that stand
    more than 0.3 m above the median of the 5 m around them (cars, walls) are dropped, and the gaps filled from ever wider averages. Without
    points the ground goes with the body.
    """
    path = ego.world_from_body[:, :3, 3].numpy()
    low, high = path[:, :2].min(0) - REACH, path[:, :2].max(0) + REACH
    cell = max(CELL, float(np.sqrt((high - low).prod() / MOST)))
    shape = tuple(int(n) for n in np.ceil((high - low) / cell)[::-1] + 1)
    distance, level = _beside(path, low, shape, cell)
    off = np.full(shape, np.nan)
    points = points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(1)]
    column, row = np.round((points[:, :2] - low) / cell).astype(np.int64).clip(0, np.array(shape[::-1]) - 1).T
    above = above_ground(points, _ground(level, low, cell))
    near = np.abs(above) < 4 + STEEPEST * distance[row, column]
    points, above, place = points[near], above[near], (row * shape[1] + column)[near]
    # what is sorted, filled and averaged is how far the ground is from what the path leads one to expect: so it goes uphill with the path
    if len(points):
        order = np.lexsort((above, place))
        cells, first, counts = np.unique(place[order], return_index=True, return_counts=True)
        off.flat[cells] = above[order][first + (counts * 0.05).astype(np.int64)]
    close = np.isfinite(off) & (distance < CLOSE)
    known = off[close] if close.any() else off[np.isfinite(off)]
    usual = float(np.percentile(known, 30)) if len(known) else 0.0
    heights = level + usual + _filled(_without_objects(off - usual, distance, cell), 0.0, cell)
    ground = _ground(heights, low, cell)
    return replace(ground, heights=ground.heights + _noise_under(points, place, ground)) if len(points) else ground


def _ground(heights: np.ndarray, low: np.ndarray, cell: float) -> Ground:
    return Ground(torch.from_numpy(heights).float(), (float(low[0]), float(low[1])), cell)


def cells_of(points: np.ndarray, ground: Ground) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns `[...]` of a ground's cells in which points `[..., 3]` are, or the nearest."""
    at = np.round((points[..., :2] - np.array(ground.origin)) / ground.cell).astype(np.int64)
    rows, columns = ground.heights.shape
    return at[..., 1].clip(0, rows - 1), at[..., 0].clip(0, columns - 1)


def above_ground(points: np.ndarray, ground: Ground) -> np.ndarray:
    """Metres `[...]` that points `[..., 3]` are above a ground."""
    return points[..., 2] - ground.height(torch.from_numpy(points[..., :2])).numpy()


def shown_ground(points: np.ndarray, ground: Ground, stray: float = STRAY) -> torch.Tensor:
    """What static points `[N, 3]` show of the ground, uint8 `[Y, X]`: `GROUND` in cells where enough of them lie on it and next to none
    below, `BARE` where besides next to none stand there or in the cells around, else 0. Between such cells its height is a guess. stray:
    how many next to none are, in parts of those that lie on it."""
    at = (points[:, :2] - np.array(ground.origin)) / ground.cell
    column, row = np.round(at).astype(np.int64).T
    rows, columns = ground.heights.shape
    off = above_ground(points, ground)
    inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)

    def count(which: np.ndarray) -> np.ndarray:
        which = which & inside
        return np.bincount(row[which] * columns + column[which], minlength=rows * columns).reshape(rows, columns)

    lying, standing, below = (
        count(which) for which in (np.abs(off) < NOISE, (off > LEAST) & (off < MOST_OFF), (-off > LEAST) & (-off < MOST_OFF))
    )
    stands = ndimage.binary_dilation(standing > stray * lying, np.ones((3, 3)))
    known = (lying >= TELLING) & (below <= stray * lying)
    return torch.from_numpy(np.where(known, np.where(stands, GROUND, BARE), 0).astype(np.uint8))


def _noise_under(points: np.ndarray, place: np.ndarray, ground: Ground) -> torch.Tensor:
    """How far points `[N, 3]` in cells `place` lie above a ground that the lowest of them tell, where they are its own and differ by noise:
    heights `[Y, X]` to be added, so that it goes through their middle."""
    off = above_ground(points, ground)
    usual = float(np.median(off[np.abs(off) < 2 * NOISE])) if (np.abs(off) < 2 * NOISE).any() else 0.0
    lying = np.abs(off - usual) < NOISE
    cells = ground.heights.numel()
    count = np.bincount(place[lying], minlength=cells)
    total = np.bincount(place[lying], off[lying], minlength=cells)
    mean = np.where(count >= TELLING, total / np.maximum(count, 1), np.nan).reshape(ground.heights.shape)
    return torch.from_numpy(_filled(mean, 0.0, ground.cell)).float()


def _beside(path: np.ndarray, low: np.ndarray, shape: tuple[int, ...], cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Each cell's distance from the path in metres, and the path's height where it is nearest; beyond its ends it goes on as steeply, and
    levels out by and by."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])
    moving = np.concatenate([[True], np.diff(way) > 1e-6])  # np.interp wants a way that rises
    at, step = np.linspace(0.0, way[-1], max(2, int(2 * way[-1] / cell)), retstep=True)
    fine = np.stack([np.interp(at, way[moving], path[moving, k]) for k in range(3)], 1)
    column, row = np.round((fine[:, :2] - low) / cell).astype(np.int64).T
    count, total = np.zeros(shape), np.zeros((*shape, 6))
    np.add.at(count, (row, column), 1)
    np.add.at(total, (row, column), np.concatenate([fine, _ways(fine, float(step))], 1))
    distance, nearest = ndimage.distance_transform_edt(count == 0, return_indices=True)
    *here, z, ahead_x, ahead_y, steepness = np.moveaxis((total / np.maximum(count, 1)[..., None])[tuple(nearest)], 2, 0)
    rows, columns = np.indices(shape)
    ahead = (low[0] + cell * columns - here[0]) * ahead_x + (low[1] + cell * rows - here[1]) * ahead_y
    return distance * cell, z + steepness * LEVELS * np.tanh(ahead / LEVELS)


def _ways(fine: np.ndarray, step: float) -> np.ndarray:
    """Directions in plan and steepness `[N, 3]` of a path along its points `[N, 3]`, so many metres apart, over `ALONG` metres; none of one
    that stands."""
    if step * len(fine) < ALONG:
        return np.zeros_like(fine)
    rises = ndimage.gaussian_filter1d(np.gradient(fine, axis=0), ALONG / step, axis=0, mode="nearest")
    return rises / np.maximum(np.linalg.norm(rises[:, :2], axis=1), 1e-9)[:, None]


def _without_objects(heights: np.ndarray, distance: np.ndarray, cell: float) -> np.ndarray:
    """Drop cells that are not road or pavement: grow outwards from the path, where the ground is about 0."""
    there = np.isfinite(heights)
    ground = there & (distance < CLOSE) & (np.abs(heights) < STEP)
    for outer in np.arange(CLOSE, 1.5 * REACH, RING):
        ring = there & (distance >= outer) & (distance < outer + RING)
        if not ring.any():
            continue
        guess, weight = _averages(ground, heights, 2.5, cell)
        slack, alone = np.full(heights.shape, STEP), weight <= 1e-3
        if (ring & alone).any():  # nothing is known around: what is wider around, and the farther from the path the less surely
            wider, weight = _averages(ground, heights, 10.0, cell)
            guess = np.where(alone, np.where(weight > 1e-4, wider, 0.0), guess)
            slack = np.where(alone, STEP + 0.04 * distance, STEP)
        ground |= ring & (np.abs(heights - guess) < slack)
    smooth = _filled(np.where(ground, heights, np.nan), 0.0, cell, start=2.5)
    return np.where(ground & (np.abs(heights - smooth) < 0.3), heights, np.nan)


def _averages(known: np.ndarray, values: np.ndarray, metres: float, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Gaussian averages of the known cells, and what part of its window each is made of."""
    weight = ndimage.gaussian_filter(known.astype(np.float32), metres / cell, mode="nearest", truncate=3)
    mean = ndimage.gaussian_filter(np.where(known, values, 0.0).astype(np.float32), metres / cell, mode="nearest", truncate=3)
    return mean / np.maximum(weight, 1e-9), weight


def _filled(heights: np.ndarray, default: float, cell: float, start: float = 0.7) -> np.ndarray:
    """Gaps (and noise) filled by averages of known cells over 0.7 m, 1.4 m, ... 12 m, and beyond by the nearest filled cell."""
    known = np.isfinite(heights)
    if not known.any():
        return np.full(heights.shape, default)
    out = np.full(heights.shape, np.nan)
    metres = start
    while np.isnan(out).any() and metres < 12:
        mean, weight = _averages(known, heights, metres, cell)
        take = np.isnan(out) & (weight > 0.05)
        out[take] = mean[take]
        metres *= 2
    nearest = ndimage.distance_transform_edt(np.isnan(out), return_distances=False, return_indices=True)
    return out[tuple(nearest)]
