"""Lidars that never were: what a turning one would have seen of a street that other sweeps show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from recon.log import LidarPoints, Log, Sweep, Track
from recon.objects.actors import split_points
from scenes.poses import inverse
from scenes.trajectory import Trajectory
from tests.layouts import carried

BEHIND = 0.4
"""Metres behind the nearest of the points in a beam's cell up to which they are taken for one surface's. A beam shows the middle one of
these: the nearest is the noise nearest to the car."""

GAP, HIDING = 0.4, 1.25
"""Degrees between the points of sparse sweeps, which lets no beam through: what is so many times as far as something within that of it is
hidden."""

AROUND, BESIDE, OFTEN = 0.4, 12, 5
"""Metres within which so many neighbours of a point must be of so many sweeps for it to be the street's: each turn would show the dust of
all sweeps."""

NEAREST = 1.0
"""Metres from a lidar at which it begins to see."""


@dataclass(frozen=True, eq=False)
class Spinner:
    """A lidar that turns once in `turn_us`, so that it looks ahead (the body's x) in the middle of it.

    place: `[3]` in the body; beams: radians above the horizon, rising and evenly spaced; columns: so many a turn; clockwise: seen from
    above; reach: metres.
    """

    place: tuple[float, float, float]
    beams: np.ndarray
    columns: int
    turn_us: int
    clockwise: bool
    reach: float

    @property
    def body_from_lidar(self) -> torch.Tensor:
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = torch.tensor(self.place)
        return pose

    def passes(self, local: np.ndarray) -> np.ndarray:
        """The part of a turn at whose end it looks at places `[N, 3]` in its frame, `[N]` from 0 to 1: it begins behind."""
        part = np.arctan2(local[:, 1], local[:, 0]) / (2 * np.pi)
        return 0.5 - part if self.clockwise else 0.5 + part

    def cells(self, local: np.ndarray) -> np.ndarray:
        """The beam's cell in which places `[N, 3]` in its frame lie, `[N]`; -1 of what it does not see."""
        away = np.linalg.norm(local, axis=1)
        step = self.beams[1] - self.beams[0]
        row = np.round((np.arcsin(local[:, 2] / np.maximum(away, 1e-9)) - self.beams[0]) / step).astype(int)
        column = (self.passes(local) * self.columns).astype(int).clip(0, self.columns - 1)
        seen = (row >= 0) & (row < len(self.beams)) & (away > NEAREST) & (away < self.reach)
        return np.where(seen, row * self.columns + column, -1)


@dataclass(frozen=True, eq=False)
class Street:
    """What sweeps show of a street: static points `[N, 3]` in the world, and by track those in its box, `[M, 3]` each.

    tracks: of what moves as it went, by the time, and of what stands.
    """

    static: np.ndarray
    movers: dict[str, np.ndarray]
    tracks: tuple[Track, ...]

    @staticmethod
    def of(log: Log, sweeps: Sequence[Sweep]) -> Street:
        split = split_points(log, sweeps, [t for t in log.tracks if t.moving])
        found = {name: points for name, (points, _) in split.actors.items()}
        return Street(
            split.static[_again(split.static, split.static_sweep)], found, (*split.tracks, *(t for t in log.tracks if not t.moving))
        )


def _again(points: np.ndarray, sweeps: np.ndarray) -> np.ndarray:
    """Which of the points `[N, 3]` of `sweeps` `[N]` several of them show, bool `[N]`."""
    beside = cKDTree(points).query(points, BESIDE, distance_upper_bound=AROUND)[1]
    of = np.sort(np.append(sweeps, -1)[beside], axis=1)  # -1 where there is no neighbour
    return (of[:, 0] >= 0) + (np.diff(of, axis=1) > 0).sum(1) >= OFTEN


def sweep(street: Street, lidar: Spinner, ego: Trajectory, begun_us: int, sensor: int = 0) -> LidarPoints:
    """What a turn that begins at a moment shows, in the world: in each beam's cell the middle point of the nearest surface, static or where
    its mover was when the lidar looked there."""
    ends = (begun_us, begun_us + lidar.turn_us)
    from_world = [inverse(ego.near(t) @ lidar.body_from_lidar) for t in ends]
    local, part = _seen(lidar, *(carried(street.static, pose) for pose in from_world))
    world = [street.static]
    for track in street.tracks:
        path = track.trajectory()
        if track.name in street.movers and path.covers((ends[0] + ends[1]) // 2):
            placed = [carried(street.movers[track.name], path.near(t)) for t in ends]
            own, when = _seen(lidar, *(carried(points, pose) for points, pose in zip(placed, from_world, strict=True)))
            local, part = np.concatenate([local, own]), np.concatenate([part, when])
            world.append(_between(*placed, when))
    shown = _first(lidar, local)
    xyz, times = np.concatenate(world)[shown], begun_us + np.round(part[shown] * lidar.turn_us).astype(np.int64)
    order = np.argsort(times, kind="stable")
    return LidarPoints(xyz[order], times[order], np.full(len(order), sensor))


def boxes(street: Street, lidar: Spinner, ego: Trajectory, begun_us: Sequence[int], stamps_us: Sequence[int]) -> tuple[Track, ...]:
    """The tracks as annotators draw them around the points of turns that begin at moments: with stamps `[K]` of their own, each box where
    its middle was when the lidar looked there, as far as it reaches. Those that are in no turn are left out."""
    drawn = []
    for track in street.tracks:
        path, found = track.trajectory(), []
        for begun, stamp in zip(begun_us, stamps_us, strict=True):
            looked = begun + lidar.turn_us // 2
            for _ in range(4):  # where it was depends on when it was looked at
                pose = path.near(looked)
                local = (inverse(ego.near(looked) @ lidar.body_from_lidar) @ pose)[None, :3, 3].numpy()
                looked = begun + round(float(lidar.passes(local)[0]) * lidar.turn_us)
            there = path.covers(looked) if track.moving else track.times_us[0] <= looked <= track.times_us[-1]
            if there and np.linalg.norm(local) < lidar.reach:
                found.append((stamp, pose))
        if found:
            times, poses = zip(*found, strict=True)
            sensor = np.full(len(times), -1)
            drawn.append(
                Track(track.name, track.label, track.moving, track.size, np.array(times), torch.stack(poses), sensor, track.sources)
            )
    return tuple(drawn)


def _seen(lidar: Spinner, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of points `[N, 3]` in the lidar's frame as a turn begins and as it ends, where they are when it looks at them, and at which part."""
    part = lidar.passes((first + last) / 2)
    for _ in range(2):
        part = lidar.passes(_between(first, last, part))
    return _between(first, last, part), part


def _between(first: np.ndarray, last: np.ndarray, part: np.ndarray) -> np.ndarray:
    return first + part[:, None] * (last - first)


def _first(lidar: Spinner, local: np.ndarray) -> np.ndarray:
    """Of points `[N, 3]` in the lidar's frame, indices of the middle ones of those in each cell that are up to `BEHIND` behind its nearest,
    in cells that nothing hides."""
    cells, away = lidar.cells(local), np.linalg.norm(local, axis=1)
    order = np.lexsort((away, cells))
    order = order[cells[order] >= 0]
    if not len(order):
        return order
    begins = np.flatnonzero(np.diff(cells[order], prepend=-1))
    first, own = away[order[begins]], cells[order[begins]]
    near = away[order] <= np.repeat(first, np.diff(begins, append=len(order))) + BEHIND  # the first of each cell's, since they are sorted
    middle = order[begins + (np.add.reduceat(near, begins, dtype=np.int64) - 1) // 2]
    grid = np.full(len(lidar.beams) * lidar.columns, np.inf)
    grid[own] = first
    steps = np.degrees(lidar.beams[1] - lidar.beams[0]), 360 / lidar.columns
    around = [2 * int(GAP / step) + 1 for step in steps]
    nearest = minimum_filter(grid.reshape(len(lidar.beams), -1), around, mode=("nearest", "wrap")).ravel()
    return middle[first <= HIDING * nearest[own]]
