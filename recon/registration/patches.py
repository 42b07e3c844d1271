"""Patches of a picture found again in a later picture of the same camera, by way of the planes on which lidar saw them.

Where lidar knows a plane, a patch is projected onto it and into the other picture, and searched for around there by normalised
cross-correlation. Rolling shutters are taken into account.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy import ndimage

from recon.log import Log, LogCamera
from recon.registration.align import Surfaces
from recon.registration.mounts_by_road import SOON_US
from recon.views.project import NEAREST, nearest_around
from scenes.camera import Camera
from scenes.poses import inverse, small_poses

WIDTH, SMOOTH = 960, 25
"""Pixels across at which pictures are compared, and the window, in pixels, whose mean brightness is taken out."""

HALF, REACH = 14, 10
"""Half the side of a patch, and how far around its expected place it is searched for, in pixels."""

APART, PATCHES, GRAIN = 16, 220, 2.0
"""Pixels between patches, how many a picture has at most, those of most texture first, and how much texture one needs: the mean gradient
of its brightness, in levels a pixel."""

NEAR, FAR, SLANTED = 2.0, 35.0, 0.08
"""Depths in metres between which planes are used, and the sine of the angle at which they must at least be seen."""

HIDING = 1.15
"""A point within half a patch hides a plane that is this many times farther away."""

ALIKE = 0.7
"""Least correlation of a match."""


@dataclass(frozen=True)
class Matches:
    """N patches of a picture that were found in another one, and what their places depend on: the mount's error, a small motion of the
    camera in its own frame (three radians, three metres) and a delay of its clock (seconds)."""

    jacobian: np.ndarray
    """`[N, 2, 7]`: derivatives of the place in the second picture for a fixed place in the first one, in pixels of the first picture."""
    offset: np.ndarray
    """`[N, 2]`: where the patch was found, less where it was expected, in pixels of the first picture."""
    curvature: np.ndarray
    """`[N, 2, 2]`: negative second derivatives of the correlation at its maximum: how well the offset is determined in each direction."""
    own_jacobian: np.ndarray
    """`[N, 2, 7]`: derivatives of the place in the first picture, in radians."""


class CameraPictures:
    """A camera's pictures, scaled for comparison, and what lidar measured around their times. stamps: of the sweeps, int64 us `[S]`;
    street: planes and points `[N, 3]` of a sweep by its place among them; pairs: how many pairs of pictures are compared."""

    def __init__(self, log: Log, camera: LogCamera, stamps: np.ndarray, street: Callable[[int], tuple[Surfaces, np.ndarray]], pairs: int):
        self.camera, self.stamps, self.street = camera, stamps, street
        self.width = min(WIDTH, camera.width)
        self.height = round(camera.height * self.width / camera.width)
        self.lens = camera.lens.scaled(self.width / camera.width, self.height / camera.height)

        @lru_cache(2 * pairs)
        def grey(index: int) -> np.ndarray:
            image = camera.image(index, self.width, self.height).astype(np.float32).mean(2)
            return image - ndimage.uniform_filter(image, SMOOTH)

        @lru_cache(2 * pairs)
        def speed(index: int) -> np.ndarray:
            time = int(camera.times_us[index])
            return (log.ego.near(time + 50_000) - log.ego.near(time - 50_000))[:3, 3].numpy() / 100_000

        @lru_cache(16 * pairs)
        def recorded(index: int, late_us: int) -> torch.Tensor:
            time = int(camera.times_us[index])
            return camera.world_from_cam[index] if not late_us else log.ego.near(time + late_us) @ offsets[index]

        offsets = inverse(log.ego.near_each(camera.times_us)) @ camera.world_from_cam
        self.grey, self.speed, self.recorded = grey, speed, recorded

    def pose(self, index: int, error: np.ndarray) -> torch.Tensor:
        """`world_from_cam` of a frame, if its mount and clock have this error `[7]`."""
        return self.recorded(index, round(float(error[6]) * 1e6)) @ small_poses(torch.from_numpy(error[:6]))

    def matches(self, first: int, second: int, error: np.ndarray) -> Matches | None:
        """Patches of the first picture that were found in the second one; None where there are none. error: `[7]`, what is known of the
        mount's error by now, by which the places to search are corrected."""
        sweep = int(np.abs(self.stamps - int(self.camera.times_us[first])).argmin())
        if abs(int(self.stamps[sweep]) - int(self.camera.times_us[first])) > SOON_US:
            return None
        places, points, normals = self._patches(self.pose(first, error), first, *self.street(sweep))
        if len(places) < 2:
            return None
        side = np.arange(-HALF - REACH, HALF + REACH + 1)
        grid = places[:, None, None] + np.stack(np.meshgrid(side, side), -1)
        transferred = self._transferred(first, second, grid, points, normals, error)
        core = transferred[:, REACH:-REACH, REACH:-REACH]
        whole = ((core > 0) & (core < [self.width, self.height])).all((1, 2, 3))
        places, points, normals, transferred = places[whole], points[whole], normals[whole], transferred[whole]
        patches = _sampled(self.grey(first), grid[whole][:, REACH:-REACH, REACH:-REACH])
        at, offset, curvature = _search(patches, _sampled(self.grey(second), transferred))
        if not len(at):
            return None
        places, points, normals, transferred = places[at], points[at], normals[at], transferred[at]
        low, mid, high = (HALF + REACH + k for k in (-1, 0, 1))
        stretch = (
            np.stack([transferred[:, mid, high] - transferred[:, mid, low], transferred[:, high, mid] - transferred[:, low, mid]], -1) / 2
        )
        usable = np.abs(np.linalg.det(stretch)) > 0.05
        jacobian, own_jacobian = [], []
        for small in np.diag([1e-4] * 6 + [1e-3]):
            ends = [error + small, error - small]
            ahead, behind = (self._transferred(first, second, places, points, normals, end) for end in ends)
            jacobian.append((ahead - behind) / (2 * small.sum()))
            ahead, behind = (self.lens.project(_seen_from(self.pose(first, end), points)).numpy() for end in ends)
            own_jacobian.append((ahead - behind) / (2 * small.sum()) / self.lens.focal()[0])
        in_first = np.linalg.solve(stretch[usable], np.stack(jacobian, -1)[usable])
        return Matches(in_first, offset[usable], curvature[usable], np.stack(own_jacobian, -1)[usable])

    def _patches(self, pose: torch.Tensor, index: int, surfaces: Surfaces, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Middles `[N, 2]` of the patches of a picture that was taken from a pose, and points and normals `[N, 3]` of the planes there."""
        local = _seen_from(pose, surfaces.points)
        depth = self.lens.depth(local).numpy()
        before = self.lens.valid(local).numpy() & (depth > NEAR) & (depth < FAR)
        points, normals, depth = surfaces.points[before], surfaces.normals[before], depth[before]
        places = self.lens.project(local[before]).numpy()
        view = points - pose[:3, 3].numpy()
        slant = np.abs((view * normals).sum(1)) / np.linalg.norm(view, axis=1)
        seen = ((places > HALF + 1) & (places < np.array([self.width, self.height]) - HALF - 1)).all(1) & (slant > SLANTED)
        points, normals, depth, places = points[seen], normals[seen], depth[seen], places[seen]
        column, row = places.astype(np.int64).T
        nearest = nearest_around(xyz, Camera(self.lens, self.width, self.height, pose), HALF // 2)
        grain = ndimage.uniform_filter(ndimage.gaussian_gradient_magnitude(self.grey(index), 1), HALF)[row, column]
        fine = np.flatnonzero((depth <= HIDING * nearest[row, column]) & (grain > GRAIN))
        best = fine[np.argsort(-grain[fine], kind="stable")]
        cells = (row[best] // APART) * self.width + column[best] // APART
        best = best[np.sort(np.unique(cells, return_index=True)[1])][:PATCHES]
        return places[best], points[best], normals[best]

    def _transferred(
        self, first: int, second: int, pixels: np.ndarray, points: np.ndarray, normals: np.ndarray, error: np.ndarray
    ) -> np.ndarray:
        """Pixels of the first picture `[N, ..., 2]` transferred to the second one by planes through `points` `[N, 3]`, each pixel at the
        time at which its row was read; far outside the picture where it does not show them."""
        shape = pixels.shape[:-1]
        points, normals = (planes.reshape(-1, *[1] * (len(shape) - 1), 3) for planes in (points, normals))
        here, there = (self.pose(k, error).numpy() for k in (first, second))
        rays = self.lens.unproject(torch.from_numpy(pixels.reshape(-1, 2))).numpy().reshape(*shape, 3) @ here[:3, :3].T
        eye = here[:3, 3] + self._late(pixels) * self.speed(first)
        with np.errstate(divide="ignore", invalid="ignore"):
            far = ((points - eye) * normals).sum(-1) / (rays * normals).sum(-1)
        on = eye + rays * np.where(np.isfinite(far) & (far > 0), far, 0.0)[..., None]
        late = np.zeros((*shape, 1))
        for _ in range(2):
            local = torch.from_numpy((on - there[:3, 3] - self.speed(second) * late) @ there[:3, :3]).reshape(-1, 3)
            shown = self.lens.project(local).numpy().reshape(*shape, 2)
            late = self._late(shown)
        before = (self.lens.valid(local) & (self.lens.depth(local) > NEAREST)).numpy().reshape(shape)
        return np.where((before & np.isfinite(shown).all(-1))[..., None], shown, -1e6)

    def _late(self, pixels: np.ndarray) -> np.ndarray:
        """Microseconds `[..., 1]` after their frame's time at which pixels were read."""
        return self.camera.late_us(pixels[..., :1] / self.width, pixels[..., 1:] / self.height)


def _seen_from(pose: torch.Tensor, points: np.ndarray) -> torch.Tensor:
    """World points `[N, 3]` in the frame of a pose."""
    return (torch.from_numpy(points) - pose[:3, 3]) @ pose[:3, :3]


def _sampled(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """An image's brightness `[...]` at pixels `[..., 2]`, 0 outside."""
    return ndimage.map_coordinates(image, [pixels[..., 1] - 0.5, pixels[..., 0] - 0.5], order=1, mode="constant")


def _search(patches: np.ndarray, fields: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices `[K]` of the patches `[N, S, S]` that were found in their fields `[N, S + 2 REACH, S + 2 REACH]`; the offset of each from its
    field's middle, right and down, `[K, 2]`; and the negative second derivatives of the correlation there, `[K, 2, 2]`. The correlation is
    normalised and weighted towards the middle of a patch."""
    count, side = len(patches), fields.shape[-1]
    window = np.hanning(patches.shape[-1] + 2)[1:-1]
    window = window[:, None] * window
    window /= window.sum()

    def over(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        spectra = [np.fft.rfft2(x, (side, side)) for x in (a, b)]
        return np.fft.irfft2(spectra[0] * spectra[1].conj(), (side, side))[:, : 2 * REACH + 1, : 2 * REACH + 1]

    means = (patches * window).sum((1, 2), keepdims=True)
    plain = patches - means
    varied = over(fields**2, window[None]) - over(fields, window[None]) ** 2
    power = np.maximum(varied, 1e-3) * np.maximum((plain**2 * window).sum((1, 2), keepdims=True), 1e-3)
    likeness = over(fields, plain * window) / np.sqrt(power)
    best = likeness.reshape(count, -1).argmax(1) if count else np.zeros(0, np.int64)
    y, x = np.unravel_index(best, likeness.shape[1:])
    peak = likeness[np.arange(count), y, x]
    at = np.flatnonzero((peak > ALIKE) & (np.minimum(x, y) > 0) & (np.maximum(x, y) < 2 * REACH))
    x, y = x[at], y[at]

    def around(right: int, down: int) -> np.ndarray:
        return likeness[at, y + down, x + right]

    middle = around(0, 0)
    falls = [2 * middle - around(1, 0) - around(-1, 0), 2 * middle - around(0, 1) - around(0, -1)]
    skew = (around(1, -1) + around(-1, 1) - around(1, 1) - around(-1, -1)) / 4
    slopes = [around(1, 0) - around(-1, 0), around(0, 1) - around(0, -1)]
    part = [0.5 * slope / np.maximum(fall, 1e-4) for slope, fall in zip(slopes, falls, strict=True)]
    off = np.stack([x - REACH + part[0], y - REACH + part[1]], -1)
    return at, off, np.stack([np.stack([falls[0], skew], -1), np.stack([skew, falls[1]], -1)], -2)
