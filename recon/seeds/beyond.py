"""What lidar does not reach, as pictures agree how far it is: crowns of trees above its beams, roofs, dark and shiny cars.

Its points are held fast in the pictures' stereo, so that what is found between and above them goes on from there.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from recon.log import Log, SparsePoints, Track
from recon.seeds.dense import AGREE, OTHERS, Depths, believed, measured_by
from recon.seeds.measured import Measured, grid_of
from recon.seeds.points import Cloud
from recon.views.frames import Frames
from recon.views.project import project
from render.rays import camera_rays
from scenes.camera import Camera
from scenes.ground import Ground
from scenes.poses import inverse

AROUND = 7
"""Side of the squares of a picture's grid in whose middle nothing is looked for if lidar struck any of their pixels: its beams may be six
rows apart."""

REACH = 60.0
"""Metres up to which pictures are asked: what is farther they misjudge, at the size at which they are compared, and it hardly moves from
aside. Of seeds from any distance drive 002's skyline blurred."""

PLAIN = 0.05
"""Contrast of squares up to which pictures are not asked: plain and clipped road looks alike at any depth; white clouds of it stood in
KITTI 0005's street."""

FEWEST = 0.01
"""Part of a picture's pixels from which on its fit is held to them: they weigh as much as all that lidar struck, and few are mostly edges.
Were both one measure, KITTI 0005's depth would be 4.2 % off for 4.0 (while little of its road was known)."""


def beyond_lidar(
    log: Log, frames: Frames, struck: Measured, ground: Ground, movers: list[Track], gains: np.ndarray
) -> tuple[Cloud, Measured]:
    """Points `[N, 3]` with colours in training pictures of which lidar measured a part, where it did not; none where pictures do not agree,
    or beams went through. And their depths, of pictures that have more than a few.

    struck: what it measured of each; gains: the cameras' exposures `[C, 3]`.
    """
    grids = {(c, i): grid_of(log.camera(frames.names[c]).camera(i, *frames.sizes[c])) for c, i in struck.views}
    found = believed(log, frames, _points(log, frames, struck, grids), ground, movers)
    kept = [own.only(_beyond(own, struck)) for own in found]
    kept = [own.only(~_seen_through(own, struck, grids)) for own in kept]
    some = [own for own in kept if np.isfinite(own.depth).mean() > FEWEST]
    return Cloud.cat([own.cloud(gains) for own in kept]), measured_by(some, struck.weight)


def _points(log: Log, frames: Frames, struck: Measured, grids: dict[tuple[int, int], Camera]) -> SparsePoints:
    """What lidar measured of pictures, as points that each of them shows."""
    xyz, count = [np.zeros((0, 3))], 0
    seen = {name: [np.zeros(0, np.int64)] * len(log.camera(name)) for name in frames.names}
    for (c, index), measured in struck.views.items():
        camera, there = grids[c, index], measured.isfinite()
        rays = camera_rays(camera).double()
        local = (rays * (measured.double() / camera.lens.depth(rays))[..., None])[there]
        xyz.append((local @ camera.world_from_cam[:3, :3].T + camera.world_from_cam[:3, 3]).numpy())
        seen[frames.names[c]][index] = np.arange(count, count + len(local))
        count += len(local)
    return SparsePoints(np.concatenate(xyz), {name: tuple(of) for name, of in seen.items()})


def _beyond(own: Depths, struck: Measured) -> np.ndarray:
    """Mask `[h, w]` of a picture's pixels within reach that are not plain, near which its own sweep struck nothing."""
    known = struck.views[own.view.camera, own.view.index].isfinite().numpy()
    near = ndimage.binary_dilation(known, np.ones((AROUND, AROUND), bool))
    return (own.depth < REACH) & (own.plate.contrast() > PLAIN) & ~near[own.cells(near.shape)]


def _seen_through(own: Depths, struck: Measured, grids: dict[tuple[int, int], Camera]) -> np.ndarray:
    """Mask `[h, w]` of a picture's pixels whose place more sweeps see through than strike, as other pictures have them: windows in which
    pictures are compared reach over the edges of what is near."""
    known = np.isfinite(own.depth)
    points = own.points()[known]
    eye = own.plate.eye()
    away = {which: np.linalg.norm(grid.world_from_cam[:3, 3].numpy() - eye) for which, grid in grids.items()}
    through, there = np.zeros((2, len(points)), np.int64)
    for which in sorted(away, key=lambda w: float(away[w]))[:OTHERS]:
        row, column, depth, inside = project(points, inverse(grids[which].world_from_cam).numpy(), grids[which])
        beams = struck.views[which].float().numpy()[row, column]  # NaN, where there is none, is neither
        through += inside & (beams > (1 + 2 * AGREE) * depth)
        there += inside & (np.abs(beams - depth) < 2 * AGREE * depth)
    mask = np.zeros(known.shape, bool)
    mask[known] = through > there
    return mask
