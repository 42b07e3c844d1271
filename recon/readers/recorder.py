"""What a log shows of the recording car itself. Lidar points: a quarter of nuScenes' sweeps are its own roof, which goes wherever the car
goes and would hold the sweeps, laid on one another, to a path along which the car stands still. And its box, where somebody drew one: it
would hide the street from the cameras in it."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import torch

from recon.log import LidarPoints, Log, Sweep, Track
from scenes.poses import inverse
from scenes.trajectory import Trajectory

LENGTH, WIDTH = 5.2, 2.2
"""Metres of the box about the middle of the lidars on its roof that is the car's: bodies begin at the rear axle, under the lidar, or
anywhere. Of the road in it a lidar on the roof sees nothing."""

HIGH, AROUND, LOW, TELLING = 1.2, 15.0, 0.02, 200
"""Metres above the ground that a car's highest lidar or camera stands at least; a robot, whose stands lower, is as much smaller. The ground
is where this part of the points within so many metres is lower, of so many points at least."""

ROOF = 0.5
"""Metres below the highest lidar up to which others are on the roof, too."""

MOMENT_US = 5000
"""Microseconds in which the car is taken to stand."""

ABOVE = 1.0
"""Metres above and below a box within which the body's own place may be: a lidar on the roof, or the road under the rear axle."""


def without_recorder(log: Log) -> Log:
    """The log without the recording car: its sweeps show nothing of it, and no box is its own."""
    own = [track.name for track in log.tracks if _is_recorder(track, log.ego)]
    for name in own:
        print(f"{log.path}: box {name} stands around the recording car, and is left out", file=sys.stderr)
    log = replace(log, tracks=tuple(track for track in log.tracks if track.name not in own))
    top = max((float(place[2]) for place in log.lidars.values()), default=0.0)
    ahead = [float(place[0]) for place in log.lidars.values() if place[2] > top - ROOF] or [0.0]
    middle, highest = (min(ahead) + max(ahead)) / 2, highest_of(log)

    def freed(sweep: Sweep) -> Sweep:
        def read() -> LidarPoints:
            points = sweep.read()
            # freed of the car's motion, its own points stand where it was when each was taken
            moments, which = np.unique(points.times_us // MOMENT_US, return_inverse=True)
            back = inverse(log.ego.near_each(torch.from_numpy(moments * MOMENT_US))).numpy()[which, :3]
            local = np.einsum("nij,nj->ni", back[..., :3], points.xyz) + back[..., 3]
            part = size_of(local, highest)
            beside = (np.abs(local[:, 0] - middle) > part * LENGTH / 2) | (np.abs(local[:, 1]) > part * WIDTH / 2)
            return LidarPoints(points.xyz[beside], points.times_us[beside], points.sensor[beside])

        return replace(sweep, read=read)

    return replace(log, sweeps=tuple(map(freed, log.sweeps)))


def highest_of(log: Log) -> float:
    """Metres above the body's own place at which its highest lidar or camera stands."""
    mounts = [inverse(log.ego.near_each(c.times_us)) @ c.world_from_cam for c in log.cameras.values() if len(c)]
    lidars = [float(place[2]) for place in log.lidars.values()]
    return max([*lidars, *(float(mount[:, 2, 3].median()) for mount in mounts)], default=0.0)


def size_of(local: np.ndarray, top: float) -> float:
    """What part of a car's size the recording one has, by a sweep's points `[N, 3]` in its body and the height of what stands highest
    there."""
    near = local[np.linalg.norm(local[:, :2], axis=1) < AROUND, 2]
    return 1.0 if len(near) < TELLING else float(np.clip((top - np.quantile(near, LOW)) / HIGH, 0.0, 1.0))


def _is_recorder(track: Track, ego: Trajectory) -> bool:
    """Whether a body's own place is in a track's box for more than half of the time that they share: others' boxes touch it at most."""
    times = torch.from_numpy(track.times_us)
    shared = ego.covers_each(times)
    place = (inverse(track.world_from_box[shared]) @ ego.at_each(times[shared]))[:, :3, 3].numpy()
    beside = (np.abs(place[:, :2]) > track.size[:2] / 2).any(1)
    return bool(len(place)) and bool(((~beside) & (place[:, 2] > -ABOVE) & (place[:, 2] < track.size[2] + ABOVE)).mean() > 0.5)
