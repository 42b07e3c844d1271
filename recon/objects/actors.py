"""What moves: which sweep points lie in moving boxes, when each box was really scanned, and what is left as static."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from recon.log import Log, Sweep, Track
from recon.objects.curves import APART_US, curved
from scenes.poses import inverse
from scenes.trajectory import all_at, all_near

MARGIN = 0.15
"""Metres around a box within which points count as the object's: annotators cut close."""

SWEPT_MARGIN = 0.4
"""Metres around a moving box within which points are kept out of the static background."""

FEW = 5
"""Points by whose times a box is dated, at least."""

REACH = 1.5
"""Metres that an object may be from where it is in the middle of a sweep when its points are taken."""

ALIKE_US = 250_000
"""Before and after a box, within which others of its track are scanned at nearly the same phase of a sweep: the lidar turns, and in a
second a car may come from ahead to beside it."""


@dataclass(frozen=True)
class Split:
    """Points sorted by what they belong to.

    static: xyz `[N, 3]` and the sweep's index `[N]`; actors: per track name local points `[N, 3]` in the box frame and the sweep's
    index `[N]`; tracks: the moving tracks, their times corrected to when the lidar passed over the box, and `curved` between them.
    """

    static: np.ndarray
    static_sweep: np.ndarray
    actors: dict[str, tuple[np.ndarray, np.ndarray]]
    tracks: tuple[Track, ...]

    def moved(self, sweep: int, time_us: int) -> np.ndarray:
        """Points `[N, 3]` that the sweep of an index has of what moves, where that is at a moment, in the world."""
        paths = {t.name: path for t in self.tracks if t.name in self.actors and (path := t.trajectory()).covers(time_us)}
        placed = [np.zeros((0, 3))]
        for name, pose in zip(paths, all_at(list(paths.values()), time_us), strict=True):
            local, of = self.actors[name]
            placed.append(local[of == sweep] @ pose[:3, :3].numpy().T + pose[:3, 3].numpy())
        return np.concatenate(placed)


CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0, 1)])
"""Those of a box of a metre whose base centre is the origin, `[8, 3]`."""


def box_skin(size: np.ndarray, step: float) -> np.ndarray:
    """Points on sides and top of a box `[length, width, height]` whose base centre is the origin."""
    axes = [np.linspace(-s / 2, s / 2, max(2, int(s / step) + 1)) for s in size]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    on = np.abs(np.abs(grid) - size / 2) < 1e-9
    return (grid + [0, 0, size[2] / 2])[on[:, 0] | on[:, 1] | (on[:, 2] & (grid[:, 2] > 0))] * 0.95


def inside(local: np.ndarray, size: np.ndarray, margin: float, below: float = 0.0) -> np.ndarray:
    """Mask `[N]` of box-frame points within the box grown by `margin` metres; the floor by `below`."""
    half = size[:2] / 2 + margin
    return (np.abs(local[:, :2]) <= half).all(1) & (local[:, 2] >= -below) & (local[:, 2] <= size[2] + margin)


def split_points(log: Log, sweeps: Sequence[Sweep], tracks: list[Track]) -> Split:
    """Sort the points of `sweeps` into static ones and those of the moving `tracks`.

    A lidar scans an object at some moment within the 100 ms of a sweep, not at the sweep's stamp; the annotated box fits the
    points of that moment. So each box's time becomes the median time of the points inside it, where there are enough. By that path
    each point is compared with where the object was when the point was taken: a second lidar passes it at another moment, and in
    sweeps between those that boxes were drawn in there is no box. Where there is one, it is the measure of its own moment.
    """
    points: deque[tuple[np.ndarray, np.ndarray]] = deque()
    scanned = {t.name: t.times_us.astype(np.float64) for t in tracks}
    stamps = {t.name: {int(time): i for i, time in enumerate(t.times_us)} for t in tracks}
    offsets: list[float] = []
    for sweep in sweeps:
        read = sweep.read()
        near = Near(read.xyz)
        for track in tracks:
            at = stamps[track.name].get(sweep.time_us)
            if at is None:
                continue
            which = near.of(track, track.world_from_box[at])
            own = which[_own(in_box(near.xyz[which], track.world_from_box[at]), track)]
            sensor = own[read.sensor[own] == track.sensor[at]]
            timed = sensor if len(sensor) >= FEW else own
            if len(timed) >= FEW:
                scanned[track.name][at] = np.median(read.times_us[timed])
                offsets.append(scanned[track.name][at] - sweep.time_us)
        points.append((read.xyz, read.times_us))
    usual = float(np.median(offsets)) if offsets else 0.0
    retimed = [_retimed(t, scanned[t.name], usual) for t in tracks]
    retimed = [(curved(track), smooth) for track, smooth in retimed]
    corrected = tuple(track for track, _ in retimed)

    # of a long drive there is no room for a point twice: what is sorted takes the place of what was read
    static = np.empty((sum(len(times) for _, times in points), 3))
    done, counts = 0, []
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {t.name: [] for t in tracks}
    for sweep in sweeps:
        xyz, times = points.popleft()
        keep, near = np.ones(len(times), dtype=bool), Near(xyz)
        # some stamp a sweep as it begins, others as it ends
        middle = (int(times.min()) + int(times.max())) // 2 if len(times) else sweep.time_us
        there = [(t, smooth, at) for t, smooth in retimed if (at := stamps[t.name].get(sweep.time_us)) is not None or _placed(t, middle)]
        for (track, smooth, at), pose in zip(there, all_near([t.trajectory() for t, *_ in there], middle), strict=True):
            path = track.trajectory()
            which = near.of(track, pose, REACH)
            if not len(which):
                continue
            taken, of = np.unique(times[which], return_inverse=True)
            if at is not None and scanned[track.name][at] != sweep.time_us:
                # the path has this box at a smoother date than that of its points, which it was drawn around
                taken = taken + round(smooth[at] - scanned[track.name][at])
            moments = torch.from_numpy(taken)
            local = in_box(xyz[which], path.near_each(moments)[of])
            keep[which[inside(local, track.size, SWEPT_MARGIN, below=-0.05)]] = False
            if (own := _own(local, track) & path.covers_each(moments).numpy()[of]).any():
                found[track.name].append((local[own], np.full(own.sum(), sweep.index)))
        counts.append(int(keep.sum()))
        static[done : done + counts[-1]] = xyz[keep]
        done += counts[-1]
    return Split(
        static[:done],
        np.repeat(np.array([s.index for s in sweeps], np.int64), counts),
        {name: (np.concatenate([p for p, _ in got]), np.concatenate([s for _, s in got])) for name, got in found.items() if got},
        corrected,
    )


class Near:
    """Points `[N, 3]`, asked for those near a box: x and y on their own, which are looked through for every box."""

    def __init__(self, xyz: np.ndarray):
        self.xyz, (self.x, self.y) = xyz, np.ascontiguousarray(xyz[:, :2].T)

    def of(self, track: Track, pose: torch.Tensor, more: float = 0.0) -> np.ndarray:
        """Indices of the points that may be in a track's box at `pose`, or so many metres around it."""
        reach = track.size.max() + 1 + more
        return np.flatnonzero((np.abs(self.x - float(pose[0, 3])) < reach) & (np.abs(self.y - float(pose[1, 3])) < reach))


def in_box(xyz: np.ndarray, world_from_box: torch.Tensor) -> np.ndarray:
    """World points `[N, 3]` in the frame of a box at one pose, or each at its own `[N, 4, 4]`."""
    back = inverse(world_from_box).numpy()
    return (back[..., :3, :3] @ xyz[:, :, None])[..., 0] + back[..., :3, 3]


def _own(local: np.ndarray, track: Track) -> np.ndarray:
    """Mask of points in a track's frame that are its own: the floor is left out, those are points of the road."""
    return inside(local, track.size, MARGIN, below=-0.08)


def _placed(track: Track, time_us: int) -> bool:
    """Whether a track's boxes shortly before and after a moment tell where it is then; also half a step beyond its ends, where it is drawn:
    a car that is annotated every half second drives on in five sweeps after its last box."""
    times = track.times_us
    if len(times) < 2:
        return False
    later = int(np.searchsorted(times, time_us).clip(1, len(times) - 1))
    step = int(times[later] - times[later - 1])
    return step <= APART_US and times[0] - step // 2 <= time_us <= times[-1] + step // 2


def _retimed(track: Track, scanned: np.ndarray, usual: float) -> tuple[Track, np.ndarray]:
    """The track at the times its boxes were scanned, and these, int64 `[T]`, of all its boxes: those that would not come later than the
    one before are left out. Boxes without points take the offset of their neighbours in time."""
    offset = scanned - track.times_us
    known = offset != 0
    places = np.arange(len(offset))
    offset = np.interp(places, places[known], offset[known]) if known.any() else np.full(len(offset), usual)
    # one odd median must not make a car jump: neighbours in time are scanned at nearly the same phase of the sweep
    smooth = np.array([np.median(offset[np.abs(track.times_us - time) <= ALIKE_US]) for time in track.times_us])
    times = np.round(track.times_us + smooth).astype(np.int64)
    rising = np.concatenate([[True], times[1:] > np.maximum.accumulate(times)[:-1] + 1000])
    poses = track.world_from_box[torch.from_numpy(rising)]
    return replace(track, times_us=times[rising], world_from_box=poses, sensor=track.sensor[rising]), times
