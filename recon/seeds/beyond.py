"""What lidar does not reach, as pictures agree how far it is: crowns of trees above its beams, roofs, dark and shiny cars.

Its points are held fast in the pictures' stereo, so that what is found between and above them goes on from there.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from recon.frames import Frames
from recon.log import Log, SparsePoints, Track
from recon.seeds.dense import agreed_points
from recon.seeds.measured import Measured, grid_of
from recon.seeds.points import Cloud
from scenes.ground import Ground

AROUND = 7
"""Side of the squares of a picture's grid in whose middle nothing is looked for if lidar struck any of their pixels: its beams may be six
rows apart."""

REACH = 60.0
"""Metres up to which pictures are asked: what is farther they misjudge, at the size at which they are compared, and it hardly moves from
aside. Without this drive 002's skyline blurred, and its held-out frames lost 0.6 dB."""


def beyond_lidar(
    log: Log, frames: Frames, struck: Measured, ground: Ground, movers: list[Track], gains: np.ndarray
) -> tuple[Cloud, Measured]:
    """Points `[N, 3]` with colours in training pictures of which lidar measured a part, where it did not, and their depths; none where
    pictures do not agree.

    struck: what it measured of each; gains: the cameras' exposures `[C, 3]`.
    """
    reach = np.ones((AROUND, AROUND), bool)
    known = {which: ndimage.binary_dilation(depth.isfinite().numpy(), reach) for which, depth in struck.views.items()}
    cloud, depths = agreed_points(log, frames, _points(log, frames, struck), ground, movers, gains, known, REACH)
    return cloud, Measured(depths, struck.weight)


def _points(log: Log, frames: Frames, struck: Measured) -> SparsePoints:
    """What lidar measured of pictures, as points that each of them shows."""
    xyz, count = [np.zeros((0, 3))], 0
    seen = {name: [np.zeros(0, np.int64)] * len(log.camera(name)) for name in frames.names}
    for (c, index), measured in struck.views.items():
        name = frames.names[c]
        camera = grid_of(log.camera(name).camera(index, frames.width, frames.height))
        rays = camera.lens.unproject(camera.pixel_centres())
        there = measured.isfinite()
        local = (rays * (measured.double() / camera.lens.depth(rays))[..., None])[there]
        xyz.append((local @ camera.world_from_cam[:3, :3].T + camera.world_from_cam[:3, 3]).numpy())
        seen[name][index] = np.arange(count, count + len(local))
        count += len(local)
    return SparsePoints(np.concatenate(xyz), {name: tuple(of) for name, of in seen.items()})
