"""Surfaces that lidar measured and no picture shows, but that a camera beside the path would see: a wall past the picture's border.

Lidar looks all around, cameras do not. Where the recorded path begins, and beside it where a camera looks ahead alone, a view from metres
aside would see the sky through walls and fences, or a few splats that swelled to close the gap.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from recon.ground import above_ground
from recon.log import Log
from recon.seeds.carpet import NEAR_GROUND
from recon.seeds.points import Cloud, middle_colours, one_a_voxel
from recon.views.frames import Frames
from recon.views.project import project
from scenes.camera import Camera
from scenes.ground import Ground
from scenes.poses import inverse
from scenes.spread import spread

SIDES = (-3.0, -1.0, 1.0, 3.0)
"""Metres to the left from where a camera would look: as far as gaps are closed (`recon/fit/openings.py`)."""

CLEAR = 5.0
"""Metres from the path within which nothing is taken: cameras from aside stand there, and a parked car's side that no picture shows would
fill their view."""

FARTHEST = 40.0
"""Metres from such a camera: what stands farther off is in pictures too, or behind what is."""

CELL = 0.1
"""Metres of the cells of which one point each is looked for."""

VIEWS = 24
"""Of a camera, spread over the drive, from beside which it is asked."""


def seen_from_aside(log: Log, frames: Frames, points: np.ndarray, known: Cloud, ground: Ground, part: float = 1.0) -> Cloud:
    """Those of world points `[N, 3]` that stand off the ground and the path and lie in no training view's frustum, but in that of one moved
    aside, with the colours of what is `known` around them and off the ground; at most one a cell. part: of `SIDES` and `CLEAR`, where gaps
    are closed less far aside."""
    points = points[one_a_voxel(points, CELL)]
    path = cKDTree(log.ego.world_from_body[:, :2, 3].numpy())
    points = points[_off(points, ground) & (path.query(points[:, :2], workers=2)[0] > part * CLEAR)]
    wanted = np.zeros(len(points), dtype=bool)
    for c in range(len(frames.names)):
        for view in spread(frames.of(c), VIEWS):
            camera, left = frames.camera(log, view), log.ego.near(view.time_us)[:3, 1]
            for metres in SIDES:
                rest = np.flatnonzero(~wanted)
                wanted[rest] = _in_view(points[rest], _moved(camera, part * metres * left))
    points = points[wanted]
    for view in frames.training():
        points = points[~_in_view(points, frames.camera(log, view), np.inf)]
    if not len(points):
        return Cloud.cat([])
    # the road is nearer to a car's sill than what pictures show of the car
    upright = _off(known.xyz, ground)
    like = upright if upright.any() else ~upright
    return Cloud(points, middle_colours(known.xyz[like], known.rgb[like], points))


def _off(points: np.ndarray, ground: Ground) -> np.ndarray:
    """Which of world points `[N, 3]` stand off the ground, bool `[N]`."""
    return above_ground(points, ground) > NEAR_GROUND


def _moved(camera: Camera, by: torch.Tensor) -> Camera:
    pose = camera.world_from_cam.clone()
    pose[:3, 3] += by
    return replace(camera, world_from_cam=pose)


def _in_view(points: np.ndarray, camera: Camera, farthest: float = FARTHEST) -> np.ndarray:
    """Which of world points `[N, 3]` a camera has before it, in its picture, bool `[N]`."""
    _, _, depth, seen = project(points, inverse(camera.world_from_cam).numpy(), camera)
    return seen & (depth < farthest)
