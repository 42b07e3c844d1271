"""What lidar does not reach: splats for pixels that neither it nor the sky explains.

Lidar sees about 15 degrees up and loses dark and shiny things. Buildings above it, wires, far blocks and windows get splats at
the depth of what stands below them in the image, since facades and poles are upright.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from scipy import ndimage

from recon.log import Track
from recon.seeds.ground_rays import ground_hits
from recon.seeds.points import Cloud, nearest_box, splats_from
from recon.seeds.sweep import companions, swept_depth
from recon.views.view import View
from scenes.camera import Camera
from scenes.gaussians import Gaussians
from scenes.ground import Ground
from scenes.spread import spread

FAR = 250.0
"""Metres to things with nothing below them that lidar reaches."""

STEP = 6
"""Pixels between filling splats."""

EVERY, VIEWS = 5, (6, 30)
"""Every how many views of a camera one is searched, and how many at least and at most: in six of drive 002's front left camera a sign on a
roof was missed."""


class Search:
    """A camera's views, searched for what neither splats nor sky explain.

    cameras: where each of `views` was taken from; gain `[3]`: the camera's exposure; tracks: what moves, whose boxes are no gaps.
    """

    def __init__(self, views: Sequence[View], cameras: Sequence[Camera], gain: np.ndarray, ground: Ground, tracks: list[Track]):
        self.views, self.gain, self.ground, self.tracks = list(views), gain, ground, tracks
        self.cameras = {v.index: camera for v, camera in zip(views, cameras, strict=True)}
        eyes = torch.stack([camera.world_from_cam[:3, 3] for camera in cameras])
        self.places = np.concatenate([[0.0], eyes.diff(dim=0).norm(dim=1).cumsum(0).numpy()])

    def __iter__(self) -> Iterator[tuple[View, Camera, np.ndarray]]:
        """Those that are searched, their cameras, and where what moves or the recording car hides what stands still, bool `[H, W]`."""
        for view in spread(self.views, int(np.clip(len(self.views) // EVERY, *VIEWS))):
            camera = self.cameras[view.index]
            hidden = np.isfinite(nearest_box(camera, self.tracks))
            yield view, camera, hidden if view.ego is None else hidden | view.ego.numpy()

    def found(
        self, view: View, camera: Camera, hidden: np.ndarray, alpha: np.ndarray, depth: np.ndarray, sky: np.ndarray, sh_count: int
    ) -> Gaussians:
        """Splats of what a view shows that is not `hidden`, as wide as their blocks (`unexplained`)."""
        depth = np.where(hidden & (alpha < 0.5), np.inf, depth)
        others = [(v, self.cameras[v.index]) for v in companions(view, self.views, self.places)]
        cloud, width = unexplained(view, camera, np.where(hidden, 1.0, alpha), depth, sky, self.gain, self.ground, others)
        return splats_from(cloud, 3 * width, sh_count, width)


def unexplained(
    view: View, camera: Camera, alpha: np.ndarray, depth: np.ndarray, sky: np.ndarray, gain: np.ndarray, ground: Ground,
    others: list[tuple[View, Camera]],
) -> tuple[Cloud, np.ndarray]:  # fmt: skip
    """World points with colours for pixels that neither splats (`alpha` `[H, W]`) nor sky explain, and their widths in metres.

    One a `STEP` x `STEP` block, at the depth (`depth` `[H, W]`, z) of the nearest explained pixel below in the column, or `FAR`, or
    farther where the `others`, views from elsewhere, say so; never under the `ground`.
    """
    half = STEP // 2
    rows, columns = np.mgrid[half : camera.height : STEP, half : camera.width : STEP]
    solid = ndimage.uniform_filter((alpha > 0.5).astype(np.float32), STEP)[rows, columns] > 0.3
    blocked = ndimage.uniform_filter(sky.astype(np.float32), STEP)[rows, columns] > 0.5
    z = _from_below(np.where(solid, depth[rows, columns], np.nan))
    want = ~solid & ~blocked
    pixels = torch.from_numpy(np.stack([columns[want], rows[want]], 1) + 0.5)
    z = swept_depth(pixels, z[want], STEP / 3, view, camera, others)
    rays = camera.lens.unproject(pixels).numpy()
    pose = camera.world_from_cam.numpy()
    z = np.minimum(z, ground_hits(pose[:3, 3], rays @ pose[:3, :3].T, ground))
    local = rays * z[:, None]
    # the mean of what of the block is no sky, half of it at least: what the sky shines into would be a pale rim before it, from aside
    street = (~sky[..., None]).astype(np.float32)
    colour, share = (ndimage.uniform_filter(x, (STEP, STEP, 1))[rows[want], columns[want]] for x in (view.evenly() * street, street))
    colour = colour / share / gain
    return Cloud(local @ pose[:3, :3].T + pose[:3, 3], colour), z * STEP / camera.lens.focal()[0]


def _from_below(depth: np.ndarray) -> np.ndarray:
    """Gaps (NaN) take the depth of the nearest known cell below in their column, else beside, else `FAR`."""
    known = np.isfinite(depth)
    rows = np.arange(len(depth))[:, None]
    below = np.where(known, rows, len(depth))
    below = np.minimum.accumulate(below[::-1], 0)[::-1]
    filled = np.where(below < len(depth), np.take_along_axis(depth, np.minimum(below, len(depth) - 1), 0), np.nan)
    # a single near lidar hit (a wire, a lamp) must not pull a whole column to it: the median of the columns around decides
    beside = np.lib.stride_tricks.sliding_window_view(np.pad(filled, ((0, 0), (2, 2)), mode="edge"), 5, axis=1)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # where nothing is known there is no median
        filled = np.where(known, depth, np.nanmedian(beside, axis=2))
    return np.where(np.isfinite(filled), filled, FAR)
