"""Boxes that are of their sweep's stamp, as a simulator's are, drawn around the sweep's points instead, as annotators draw them.

A lidar turns: it passes over a car up to a tenth of a second before or after the stamp, and at 30 m/s that is three metres. All else here
takes a box to be where its sweep's points are. Of boxes that are not, what is fast would lose a part of its points, and be put together of
the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from recon.log import Log, Sweep, Track
from recon.movers.steadying import ABOVE
from recon.objects.actors import MARGIN, Near, in_box, inside
from recon.objects.curves import curved
from scenes.spread import spread

FEWEST = 8
"""Points of a sweep by which it is known when the lidar passed."""

LOOKS = 30
"""Sweeps, spread over the drive, that are asked of which moments boxes are."""

MOVED = 0.3
"""Metres that something moves between the stamp and then, at least, for it to tell of which of them its box is."""

MORE = 1.1
"""Times as many points as are in boxes as they are must be in them as of their stamps' moments."""


def as_drawn(log: Log, sweeps: Sequence[Sweep]) -> Log:
    """The log with each moving box where its object was when the lidar passed over it, if more points of `sweeps` say that boxes are of
    the stamps' moments; as it was otherwise."""
    tracks = {i: _Boxes(t) for i, t in enumerate(log.tracks) if t.moving and len(t.times_us) > 1}
    stamps = {int(time) for boxes in tracks.values() for time in boxes.track.times_us}
    boxed = [sweep for sweep in sweeps if sweep.time_us in stamps]
    some = spread(boxed, LOOKS)

    def count(sweeps: Sequence[Sweep]) -> None:
        for sweep in sweeps:
            read = sweep.read()
            near = Near(read.xyz)
            for boxes in tracks.values():
                boxes.count(sweep.time_us, near, read.times_us)

    count(some)
    drawn, stamped = (sum(boxes.points[k] for boxes in tracks.values()) for k in (0, 1))
    if stamped <= MORE * drawn:
        return log
    count([sweep for sweep in boxed if sweep not in some])
    late = [late for boxes in tracks.values() for late in boxes.late.values()]
    moved = [tracks[i].drawn(float(np.median(late))) if i in tracks else track for i, track in enumerate(log.tracks)]
    return replace(log, tracks=tuple(moved))


@dataclass
class _Boxes:
    """A track, how many `points` are in its boxes as they are, and as of their stamps' moments, of those that tell; and by box, how many
    microseconds after the stamp the lidar passed over it if they are the latter."""

    track: Track
    points: list[int] = field(default_factory=lambda: [0, 0])
    late: dict[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.path = curved(self.track).trajectory()
        self.row = {int(time): k for k, time in enumerate(self.track.times_us)}

    def count(self, stamp_us: int, near: Near, times_us: np.ndarray) -> None:
        """Look at what a sweep, its points and their times, has in and around the box of its stamp, if there is one."""
        k = self.row.get(stamp_us)
        if k is None:
            return
        pose = self.track.world_from_box[k]
        which = near.of(self.track, pose, self.track.size.max())
        if not len(which):
            return
        times, of = np.unique(times_us[which], return_inverse=True)
        own = [self._own(near.xyz[which], poses) for poses in (pose, self.path.near_each(torch.from_numpy(times))[of])]
        if own[1].sum() >= FEWEST:
            self.late[k] = float(np.median(times_us[which[own[1]]])) - stamp_us
            if float((self.path.near(round(stamp_us + self.late[k])) - pose)[:3, 3].norm()) >= MOVED:
                self.points = [count + int(o.sum()) for count, o in zip(self.points, own, strict=True)]

    def _own(self, xyz: np.ndarray, poses: torch.Tensor) -> np.ndarray:
        """Mask of world points `[N, 3]` that are the object's where it is at `poses`, one or `[N, 4, 4]`."""
        local = in_box(xyz, poses)
        return inside(local, self.track.size, MARGIN) & (local[:, 2] > ABOVE)

    def drawn(self, usual_us: float) -> Track:
        """The track with its boxes where they were when the lidar passed: as late as over those beside it of which that is known, or as
        usual."""
        known = sorted(self.late)
        places = np.arange(len(self.track.times_us))
        late = np.interp(places, known, [self.late[k] for k in known]) if known else np.full(len(places), usual_us)
        moments = torch.from_numpy(self.track.times_us + np.round(late).astype(np.int64))
        return replace(self.track, world_from_box=self.path.near_each(moments))
