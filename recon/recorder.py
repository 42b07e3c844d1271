"""Lidar points on the recording car itself: a quarter of nuScenes' sweeps are its own roof, which goes wherever the car goes and would hold
the sweeps, laid on one another, to a path along which the car stands still."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from recon.log import LidarPoints, Log, Sweep
from scenes.poses import inverse

LENGTH, WIDTH = 5.2, 2.2
"""Metres of the box about the middle of the lidars on its roof that is the car's: bodies begin at the rear axle, under the lidar, or
anywhere. Of the road in it a lidar on the roof sees nothing."""

ROOF = 0.5
"""Metres below the highest lidar up to which others are on the roof, too."""

MOMENT_US = 5000
"""Microseconds in which the car is taken to stand."""


def without_recorder(log: Log) -> Log:
    """The log with sweeps that show nothing of the car that carries the lidar."""
    top = max((float(place[2]) for place in log.lidars.values()), default=0.0)
    ahead = [float(place[0]) for place in log.lidars.values() if place[2] > top - ROOF] or [0.0]
    middle = (min(ahead) + max(ahead)) / 2

    def freed(sweep: Sweep) -> Sweep:
        def read() -> LidarPoints:
            points = sweep.read()
            # freed of the car's motion, its own points stand where it was when each was taken
            moments, which = np.unique(points.times_us // MOMENT_US, return_inverse=True)
            back = inverse(log.ego.near_each(torch.from_numpy(moments * MOMENT_US))).numpy()[which, :2]
            local = np.einsum("nij,nj->ni", back[..., :3], points.xyz) + back[..., 3]
            beside = (np.abs(local[:, 0] - middle) > LENGTH / 2) | (np.abs(local[:, 1]) > WIDTH / 2)
            return LidarPoints(points.xyz[beside], points.times_us[beside], points.sensor[beside])

        return replace(sweep, read=read)

    return replace(log, sweeps=tuple(map(freed, log.sweeps)))
