"""Lays boxes of what moves where lidar's points in them meet, along a path that something heavy can take.

Annotators and networks draw each box anew, decimetres off now to one side and now to the other, or only every half second and evenly
between. What is in such boxes smears once it is put together, and so do its splats. The points that each sweep has in a track's boxes are
registered point to plane (Chen and Medioni 1992) to those of all sweeps; the poses of a track are found together, with its boxes as priors,
and forces as large as a driver's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from recon.log import LidarPoints, Log, Sweep, Track
from recon.movers.boxing import bends
from recon.objects.actors import inside
from recon.objects.curves import APART_US, curved
from recon.objects.tracks import LIMBED, upright
from recon.registration.align import Grain, Surfaces, met, thinned
from scenes.poses import inverse, yaw_of

AROUND, ABOVE = 0.4, 0.2
"""Metres around a box within which points may be its object's, and above its floor from which on: lower ones are the road's."""

TWICE_US = 10_000
"""Between two moments of a track, at least: a second lidar may see it at nearly the same."""

PACE_US = 250_000
"""Half the time over which a speed is taken: boxes that are off are so for one moment."""

CELL = 0.06
"""Metres: a sweep keeps one point of an object in each such cell."""

SKIN = Grain(cell=0.1, kept=1500, neighbours=30, flat=0.8, amid=True)
"""How finely the surface of an object is told by all sweeps together."""

FEWEST, SURE = 8, 2.0
"""Points of a sweep that must meet that surface, and how much surer each is of it than a point of a street: they are thinned less."""

REACH = (0.6, 0.4, 0.3, 0.2, 0.2, 0.2, 0.2)
"""Metres up to which a surface is searched for, round by round."""

TOLD = 3
"""Rounds after which it is known how far off a track's boxes are."""

OFF = np.array([0.15, 0.15, 0.1, 0.05])
"""Metres in the world's axes, and radians, by which boxes are taken to be off at first; then between a fifth and twice as much."""

PUSH = np.array([2.0, 2.0, 0.5, 0.15])
"""Metres and radians a second squared by which things speed up, brake and turn."""

WORTH = np.array([0.03, 0.03, 0.03, 0.006])
"""Metres and radians by which some box of a track must be off for the track to be corrected."""

FREE = [3, 4, 5, 2]
"""Of a small motion, which is a turn and a way: what is found, the way and the turn about the box's own axis."""


def steadied(log: Log, sweeps: Sequence[Sweep]) -> Log:
    """The log with the boxes of what moves, and does not bend, where its points in `sweeps` meet; also where sweeps show it between boxes.
    Tracks whose boxes do so already are as they were."""
    if not sweeps:
        return log
    looks = {i: _Look(t) for i, t in enumerate(log.tracks) if t.moving and t.label not in LIMBED and len(t.times_us) > 2}
    for sweep in sweeps:
        if there := [look for look in looks.values() if look.tells(sweep.time_us)]:
            read = sweep.read()
            for look in there:
                look.at(sweep.time_us, read)
    tracks = list(log.tracks)
    for i, look in looks.items():
        tracks[i] = _Path(look).registered()
    return replace(log, tracks=tuple(tracks))


@dataclass(frozen=True)
class _Seen:
    """Points `[N, 3]` of an object in the frame of a `pose` `[4, 4]`, and how many microseconds after the sweep's stamp they were taken."""

    points: np.ndarray
    pose: torch.Tensor
    late_us: float


class _Look:
    """What sweeps show of a track: `seen` by their stamps."""

    def __init__(self, track: Track):
        self.track, fine = track, curved(track)
        self.path, self.times = fine.trajectory(), fine.times_us
        self.row = {int(time): k for k, time in enumerate(track.times_us)}
        self.seen: dict[int, _Seen] = {}

    def tells(self, time_us: int) -> bool:
        """Whether the track's boxes tell where it is at a moment."""
        later = int(np.searchsorted(self.times, time_us).clip(1, len(self.times) - 1))
        known = self.times[later] - self.times[later - 1] <= APART_US
        return bool(self.times[0] <= time_us <= self.times[-1] and known)

    def at(self, stamp_us: int, read: LidarPoints) -> None:
        """Look for it in a sweep: in its box, or where it is between its boxes when the lidar passes."""
        if (k := self.row.get(stamp_us)) is not None:
            seen = self._around(read, stamp_us, self.track.world_from_box[k], int(self.track.sensor[k]))
        elif (seen := self._around(read, stamp_us, self.path.near(stamp_us))) is not None:
            seen = self._around(read, stamp_us, self.path.near(stamp_us + round(seen.late_us - self.usual())))
        if seen is not None:
            self.seen[stamp_us] = seen

    def usual(self) -> float:
        """How late it is scanned where its boxes are of a sweep's stamp: they are drawn around its points, whenever these are taken."""
        known = [self.seen[t].late_us for t in self.row if t in self.seen]
        return float(np.median(known)) if known else 0.0

    def _around(self, read: LidarPoints, stamp_us: int, pose: torch.Tensor, lidar: int = -1) -> _Seen | None:
        """What a sweep has in and around a box at a pose; of the lidar that it was drawn for, since another passes at another moment."""
        size, back = self.track.size, inverse(pose).numpy()
        near = np.flatnonzero((np.abs(read.xyz[:, :2] - pose[:2, 3].numpy()) < size.max() + 1).all(1))
        local = read.xyz[near] @ back[:3, :3].T + back[:3, 3]
        own = inside(local, size, AROUND) & (local[:, 2] > ABOVE)
        its = own & (read.sensor[near] == lidar)
        own = its if its.sum() >= FEWEST else own
        if own.sum() < FEWEST:
            return None
        # where boxes do not say for which lidar they are, all passed, at moments of their own
        times, lidars = read.times_us[near[own]] - stamp_us, read.sensor[near[own]]
        passed = [float(np.median(times[lidars == n])) for n in np.unique(lidars) if (lidars == n).sum() >= FEWEST]
        late = float(np.mean(passed)) if passed else float(np.median(times))
        before, after = (self.path.near(stamp_us + d)[:3, 3].numpy() for d in (-PACE_US, PACE_US))
        on = (after - before) / (2 * PACE_US) @ pose[:3, :3].numpy()
        local = local[own] - (times - late)[:, None] * on
        return _Seen(local[thinned(local, CELL)], pose, late)


def _rows(look: _Look) -> list[tuple[float, int, int, bool]]:
    """A track's boxes, and what sweeps show of it between them, in time order: the moment at which the lidar passed, the time that the
    track has for it, the stamp of the sweep, in microseconds, and whether it is a box."""
    own = look.track.times_us
    late = {time: seen.late_us for time, seen in look.seen.items()}
    dated = [t for t in own.tolist() if t in late]
    usual = np.interp(own, dated, [late[t] for t in dated]) if dated else np.zeros(len(own))
    between = np.array(sorted(late.keys() - look.row.keys()), dtype=np.int64)
    taken = between + np.array([late[int(t)] for t in between])
    # boxes of that moment, as late as the lidar passes over those around it, would be drawn for these
    times = np.round(taken - np.interp(taken, own + usual, usual)).astype(np.int64)
    boxes = zip(own + usual, own, own, np.ones(len(own), dtype=bool), strict=True)
    others = zip(taken, times, between, np.zeros(len(between), dtype=bool), strict=True)
    rows: list[tuple[float, int, int, bool]] = []
    for row in sorted([*boxes, *others]):
        close = bool(rows) and (row[0] - rows[-1][0] < TWICE_US or row[1] <= rows[-1][1])
        if close and row[3] and not rows[-1][3]:
            rows.pop()  # a box tells more
        if row[3] or not close:
            rows.append(row)
    return rows


class _Path:
    """A track's poses while they are found: `now` `[K, 4]`, places and headings, and as `poses` `[K, 4, 4]`; its `boxes` `[K, 4]`, of which
    it `has` `[K]` some, and the others lie between; and their poses, `drawn`, for what else they say."""

    def __init__(self, look: _Look):
        self.track = look.track
        moments, self.times, seen, self.has = map(np.array, zip(*_rows(look), strict=True))
        self.drawn = look.path.near_each(torch.from_numpy(self.times))
        self.boxes = np.column_stack([self.drawn[:, :3, 3].numpy(), np.unwrap(yaw_of(self.drawn).numpy())])
        self.seen = {k: look.seen[t] for k, t in enumerate(seen.tolist()) if t in look.seen}
        apart = TWICE_US * np.arange(len(moments))
        bend = bends((np.maximum.accumulate(moments - apart) + apart) / 1e6)
        self.calm = bend.T @ bend
        self.now, self.off = self.boxes, OFF
        self._step({})

    def registered(self) -> Track:
        """The track with its points laid on one another; as it was where that is hardly anything else."""
        if self.seen:
            self._register()
        if (np.abs(self.now - self.boxes) < WORTH).all():
            return self.track
        sensor = self.track.sensor[np.searchsorted(self.track.times_us, self.times).clip(max=len(self.track.sensor) - 1)]
        return replace(self.track, times_us=self.times, world_from_box=self.poses, sensor=np.where(self.has, sensor, -1))

    def _register(self) -> None:
        rows, centre, still = list(self.seen), np.zeros(3), np.eye(4)
        looked = torch.stack([self.seen[k].pose for k in rows])
        for round_, reach in enumerate(REACH):
            moved = (inverse(self.poses[rows]) @ looked).numpy()
            laid = [self.seen[k].points @ pose[:3, :3].T + pose[:3, 3] for k, pose in zip(rows, moved, strict=True)]
            skin = Surfaces.of(np.concatenate(laid), centre, SKIN)
            if not len(skin.points):
                return
            if round_ == TOLD:
                self.off = np.clip(1.48 * np.median(np.abs(self.now - self.boxes)[self.has], axis=0), OFF / 5, 2 * OFF)
            placed = zip(rows, moved, strict=True)
            self._step({k: met(self.seen[k].points, centre, skin, pose, still, reach, FEWEST) for k, pose in placed})

    def _step(self, blocks: dict[int, tuple[np.ndarray, np.ndarray]]) -> None:
        """Find the poses anew (Gauss and Newton): those that boxes and forces make likely and, by row, normal equations `[12, 12]`, `[12]`
        of points."""
        count = len(self.times)
        matrix, right = np.zeros((count, 4, count, 4)), -self.calm @ self.now / PUSH**2
        off = (self.now - self.boxes) / self.off
        # what is farther off than three times what is likely pulls no harder (Huber 1964)
        pull = np.where(self.has[:, None], np.minimum(1, 3 / np.maximum(np.abs(off), 1e-9)), 1e-9) / self.off
        right -= pull * off
        for axis in range(4):
            matrix[:, axis, :, axis] = self.calm / PUSH[axis] ** 2 + np.diag(pull[:, axis] / self.off[axis])
        cos, sin = np.cos(self.now[:, 3]), np.sin(self.now[:, 3])
        back = np.stack([np.stack([cos, sin], 1), np.stack([-sin, cos], 1)], 1)
        for k, (normal, wanted) in blocks.items():
            # points that move back in the box are a box that moves on
            on = -np.eye(4)
            on[:2, :2] = -back[k]
            matrix[k, :, k] += SURE * on.T @ normal[np.ix_(FREE, FREE)] @ on
            right[k] += SURE * on.T @ wanted[FREE]
        self.now = self.now + np.linalg.solve(matrix.reshape(4 * count, -1), right.ravel()).reshape(count, 4)
        self.poses = upright(np.zeros((count, 3)), self.now[:, 3] - self.boxes[:, 3]) @ self.drawn
        self.poses[:, :3, 3] = torch.from_numpy(self.now[:, :3])
