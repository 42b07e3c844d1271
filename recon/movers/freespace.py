"""What must have moved: points that stand where other sweeps saw through (visibility in range images; Kim and Kim 2020, "Remove, then
Revert")."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from recon.log import LidarPoints, Log
from scenes.trajectory import Trajectory

OFFSETS = (0.2, 0.3, 0.4, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6)
"""Seconds before and after a sweep at which others are asked: near ones for what is fast, far ones for what waits before it goes on."""

PER_CELL, CELL = 2.0, (0.4, 2.0)
"""Points that a range image's cell has on average, and the least and the largest side of one, in degrees. What a lidar covers of the sphere
is taken to be `BAND` degrees high."""

BAND = 25.0

FARTHER = 0.5, 0.02
"""Metres, and parts of the distance, that others must have seen farther than a point to have seen through it."""

NEAREST = 0.05
"""Metres by which a cell's range is that of a point in it."""

AUDIBLE, ROW = 10.0, 0.1
"""Metres up to which whatever is there comes back, and the part of a row's cells that have a return where a lidar looks at all."""

TURN = 16
"""Parts of a sweep in which the lidar goes straight on."""


@dataclass(frozen=True)
class RangeImage:
    """What one lidar saw in a sweep: `range_m` `[H, W]`, how far it saw in each direction, elevation by azimuth in cells of `cell` degrees;
    inf where nothing came back, as in its first row and its last, -inf where what did is not to count (`without`). `clear_m` is the least
    of a cell and its eight neighbours, `told` how many of them had a return. Rows begin `lowest` cells above straight down. `stood`
    `[W, 3]` is where it was when it looked at an azimuth, `middle` `[3]` where it was half-way."""

    range_m: np.ndarray
    clear_m: np.ndarray
    told: np.ndarray
    cell: float
    lowest: int
    middle: np.ndarray
    stood: np.ndarray

    def votes(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whether it saw through the world points `[N, 3]`, and whether it saw something where they are: bool `[N]` each."""
        return self._votes(*self._where(xyz))

    def votes_with_silence(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same, where it has also seen through what is no farther than `AUDIBLE` if it looked there and nothing at all came back."""
        away, row, column = self._where(xyz)
        through, there = self._votes(away, row, column)
        returned = np.isfinite(self.range_m) | np.isneginf(self.range_m)
        looked = (returned.mean(1) > ROW)[row] & returned.any(0)[column]
        return through | (looked & (self.told[row, column] == 0) & (away < AUDIBLE)), there

    def without(self, xyz: np.ndarray) -> RangeImage:
        """The image as it would count what it saw at its points `[N, 3]` as seen, but as nothing that is there: they move."""
        away, row, column = self._where(xyz)
        nearest = np.abs(self.range_m[row, column] - away) < NEAREST
        range_m = self.range_m.copy()
        range_m[row[nearest], column[nearest]] = -np.inf
        return replace(self, range_m=range_m)

    def _votes(self, away: np.ndarray, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        margin = FARTHER[0] + FARTHER[1] * away
        clear = self.clear_m[row, column]
        through = (self.told[row, column] >= 2) & (clear > away + margin)
        return through, np.abs(self.range_m[row, column] - away) < margin

    def _where(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How far world points `[N, 3]` were from it, and in which row and column of the image they are."""
        _, _, column = _cells(xyz - self.middle, self.cell)
        away, row, column = _cells(xyz - self.stood[column], self.cell)
        return away, (row - self.lowest).clip(0, len(self.told) - 1), column


def range_images(log: Log, read: Iterable[tuple[int, LidarPoints]]) -> list[tuple[int, RangeImage]]:
    """Time and range image of each lidar that has points in a sweep and of which it is known where it stands; sweeps by time and points."""
    found = []
    for time, points in read:
        for sensor in (k for k in np.unique(points.sensor).tolist() if k in log.lidars):
            mine = points.sensor == sensor
            some = LidarPoints(points.xyz[mine], points.times_us[mine], points.sensor[mine])
            found.append((time, range_image(some, log.ego, log.lidars[sensor])))
    return found


def range_image(points: LidarPoints, ego: Trajectory, mount: np.ndarray) -> RangeImage:
    """The range image of one lidar's points of a sweep, which has some; `mount` `[3]` is where it stands in the body."""
    times = points.times_us
    knots = np.unique(np.linspace(times.min(), times.max(), TURN + 1).round().astype(np.int64))
    poses = np.stack([ego.near(int(t)).numpy() for t in knots])
    eyes = poses[:, :3, :3] @ mount + poses[:, :3, 3]
    columns = round(360 / float(np.clip(np.sqrt(PER_CELL * 360 * BAND / len(times)), *CELL)))
    cell = 360 / columns
    away, row, column = _cells(points.xyz - _at(times, knots, eyes), cell)
    lowest = int(row.min()) - 1
    row = row - lowest
    shape = int(row.max()) + 2, columns
    seen = np.full(shape, np.inf, np.float32)
    np.minimum.at(seen, (row, column), away)
    around = {"size": 3, "mode": ("nearest", "wrap")}
    told = np.rint(9 * ndimage.uniform_filter(np.isfinite(seen).astype(np.float32), **around)).astype(np.uint8)
    told[[0, -1]] = 0
    passed, counts = np.zeros(shape[1]), np.bincount(column, minlength=shape[1])
    np.add.at(passed, column, times - knots[0])
    passed = knots[0] + np.where(counts > 0, passed / np.maximum(counts, 1), (times - knots[0]).mean())
    return RangeImage(seen, ndimage.minimum_filter(seen, **around), told, cell, lowest, eyes[len(eyes) // 2], _at(passed, knots, eyes))


def _at(times_us: np.ndarray, knots_us: np.ndarray, eyes: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(times_us, knots_us, eyes[:, k]) for k in range(3)], 1)


def _cells(towards: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Length, row and column of directions `[N, 3]`."""
    towards = towards.astype(np.float32)
    away = np.linalg.norm(towards, axis=1)
    elevation = np.degrees(np.arcsin(np.clip(towards[:, 2] / np.maximum(away, np.float32(1e-6)), -1, 1)))
    azimuth = np.degrees(np.arctan2(towards[:, 1], towards[:, 0]))
    return away, ((elevation + 90) / cell).astype(np.int64), ((azimuth + 180) / cell).astype(np.int64) % round(360 / cell)


def tally(xyz: np.ndarray, time_us: int, others: list[tuple[int, RangeImage]]) -> tuple[np.ndarray, np.ndarray]:
    """How many of the range images nearest to `OFFSETS` saw through the points `[N, 3]` of a sweep at a time, and how many saw something
    there: int `[N]` each. others: time in us and range image; an offset that has none within a half of itself asks nobody."""
    through, there = np.zeros(len(xyz), np.int64), np.zeros(len(xyz), np.int64)
    times = np.array([t for t, _ in others])
    asked = set()
    for offset in OFFSETS:
        for wanted in (time_us - 1e6 * offset, time_us + 1e6 * offset):
            nearest = np.abs(times - wanted).min(initial=np.inf)
            if nearest < 0.5e6 * offset:
                asked.update(np.flatnonzero(np.abs(times - wanted) == nearest).tolist())
    for index in sorted(asked):
        saw_through, saw = others[index][1].votes(xyz)
        through += saw_through
        there += saw
    return through, there
