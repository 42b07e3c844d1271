"""Lidar points on the recording car itself: a quarter of nuScenes' sweeps are its own roof, which goes wherever the car goes and would hold
the sweeps, laid on one another, to a path along which the car stands still."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from recon.log import LidarPoints, Log, Sweep
from scenes.poses import inverse

LENGTH, WIDTH = 5.2, 2.2
"""Metres of the box about the middle of its lidars that is the car's: bodies begin at the rear axle, under the lidar, or anywhere. Of the
road in it a lidar on the roof sees nothing."""


def without_recorder(log: Log) -> Log:
    """The log with sweeps that show nothing of the car that carries the lidar."""
    ahead = [float(place[0]) for place in log.lidars.values()] or [0.0]
    middle = (min(ahead) + max(ahead)) / 2

    def freed(sweep: Sweep) -> Sweep:
        def read() -> LidarPoints:
            points, back = sweep.read(), inverse(log.ego.near(sweep.time_us)).numpy()
            local = points.xyz @ back[:2, :3].T + back[:2, 3]
            beside = (np.abs(local[:, 0] - middle) > LENGTH / 2) | (np.abs(local[:, 1]) > WIDTH / 2)
            return LidarPoints(points.xyz[beside], points.times_us[beside], points.sensor[beside])

        return replace(sweep, read=read)

    return replace(log, sweeps=tuple(map(freed, log.sweeps)))
