"""Cameras that look elsewhere than recorded: what one picture shows on surfaces that lidar measured lies beside them in the next.

A mount that is off by half a degree puts every colour beside its surface, and a fit begins with splats of wrong colours at right places, or
of right ones at wrong. Pieces of a picture where lidar knows a plane are carried onto it and on into a picture taken a few metres further
on, and looked for around there. How far a piece goes between the two depends on where the plane stands to the camera: by all of them,
near and far, to all sides, the six parts of the mount, and by how much the camera's clock is off, are found together (Gauss-Newton), as
far as they are likely to be off. Neither intensities nor marks are asked for. What pieces do not tell, as how far ahead a camera stands on
a straight road, stays as it was; whether it stands there or its clock is off, speeds and turns tell.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy import ndimage

from recon.actors import SWEPT_MARGIN, inside
from recon.align import FARTHEST, Surfaces
from recon.corrected import TURNED, as_corrected
from recon.fit.model import small_poses
from recon.log import Log, LogCamera, Sweep
from recon.mounts import OVERLAP, SOON_US, far_pairs
from recon.project import NEAREST, nearest_around
from scenes.camera import Camera
from scenes.poses import inverse
from scenes.trajectory import all_near

WIDTH, SMOOTH = 960, 25
"""Pixels across at which pictures are looked at, and over which their brightness is evened out."""

PAIRS = 16
"""Of pictures of a camera, spread over the span."""

HALF, REACH = 14, 10
"""Pixels: half a piece, and how far around it is looked for."""

APART, PIECES, GRAIN = 16, 220, 2.0
"""Pixels between pieces, how many of a pair, those of most grain, and how much of it, in levels a pixel, a piece has to have."""

NEAR, FAR, SLANTED = 2.0, 35.0, 0.08
"""Metres before the camera within which surfaces are asked, and the sine of the angle at which they are seen at least."""

HIDING = 1.15
"""How many times nearer a point within half a piece must be to hide a surface."""

ALIKE, TELLING = 0.7, 0.02
"""Correlation from which on a piece is found again; and how much of it is lost a pixel aside, squared, where its place is told well."""

LIKELY = (0.005, 0.005, 0.005, 0.05, 0.05, 0.05, 0.01)
"""Radians and metres by which a mount is likely to be off, and seconds by which a clock is."""

FEWEST, ROUNDS = 150, 4
"""Pieces that have to be found again for a camera's mount to be told, and how often they are looked for at most."""

LEAST, SURE = 0.009, 8.0
"""Radians by which pieces have to lie beside where the recorded mount shows them for it to be corrected, and standard errors of that. With
less a fit copes by itself, and what is found depends on the span."""

DONE = 0.0003
"""Radians of the same below which a correction changes no more."""

MEET = 0.35
"""Pixels that half of what pieces tell may be off once the mount is put right: else something else is wrong."""


BELOW = 0.1
"""Metres below a mover's box that are its own."""


@dataclass(frozen=True)
class Pieces:
    """Pieces of pictures found again, `[N]`: how a mount's parts move them in the second picture against the first, as lidar's planes say,
    `by` `[N, 2, 7]`, and how far they lie from there, `off` `[N, 2]`, in pixels of the first picture; how well each tells that, `told`
    `[N, 2, 2]`; and how the parts move them in the first one, `shown` `[N, 2, 7]`, in radians."""

    by: np.ndarray
    off: np.ndarray
    told: np.ndarray
    shown: np.ndarray


def turned_by_surfaces(
    log: Log, names: Sequence[str], sweeps: Sequence[Sweep], span_us: tuple[int, int], report: Callable[[], None] = lambda: None
) -> Log:
    """The log with those of the cameras `names` turned and moved whose pictures of a span show that they are fixed otherwise than recorded
    to the car that `sweeps` were taken from, as `meta` then says; as it is where none do. All pictures of the span count, also those that
    a fit holds out, as for the path. `report` is called for each camera."""

    @lru_cache(PAIRS)
    def street(sweep: int) -> tuple[Surfaces, np.ndarray]:
        return _standing(log, sweeps[sweep])

    stamps = np.array([sweep.time_us for sweep in sweeps], dtype=np.int64)
    found = {}
    for name in names:
        off = _off(_Look(log, log.camera(name), stamps, street), far_pairs(log.camera(name), span_us, PAIRS)) if len(sweeps) else None
        if off is not None:
            found[name] = off.tolist()
            degrees, metres = math.degrees(float(np.linalg.norm(off[:3]))), float(np.linalg.norm(off[3:6]))
            moved = f"turned by {degrees:.2f} degrees, moved by {100 * metres:.1f} cm and {1e3 * off[6]:+.0f} ms later"
            print(f"{log.path}: {name} is taken {moved} than recorded, where surfaces meet in its pictures", file=sys.stderr)
        report()
    return as_corrected(log, {TURNED: found}) if found else log


def _standing(log: Log, sweep: Sweep) -> tuple[Surfaces, np.ndarray]:
    """Surfaces and points `[N, 3]` of a sweep without what annotated movers occupy."""
    xyz, body = sweep.read().xyz, log.ego.near(sweep.time_us)[:3, 3].numpy()
    xyz = xyz[np.linalg.norm(xyz - body, axis=1) < FARTHEST]
    movers = [t for t in log.tracks if t.moving and t.times_us[0] <= sweep.time_us <= t.times_us[-1]]
    for track, pose in zip(movers, all_near([t.trajectory() for t in movers], sweep.time_us) if movers else (), strict=True):
        turn, place = pose[:3, :3].numpy(), pose[:3, 3].numpy()
        xyz = xyz[~inside((xyz - place) @ turn, track.size, SWEPT_MARGIN, BELOW)]
    return Surfaces.of(xyz, body), xyz


def _off(look: _Look, pairs: Sequence[tuple[int, int]]) -> np.ndarray | None:
    """The motion in a camera's own frame from where it is recorded to where its pictures meet, and by how many seconds they were taken
    later, `[7]`; None where they do not tell, or do."""
    off, before = np.zeros(7), 0.0
    for _ in range(ROUNDS):
        found = [pieces for i, j in pairs if (pieces := look.pieces(i, j, off)) is not None]
        if sum(len(pieces.off) for pieces in found) < FEWEST:
            return None
        off, within, left = _settled(found, off)
        beside = np.concatenate([pieces.shown for pieces in found]) @ off
        far = math.sqrt(float(np.square(beside).sum(1).mean()))
        if far < LEAST / 2 or abs(far - before) < DONE:
            break
        before = far
    return off if far >= LEAST and float(off @ within @ off) > SURE**2 and left < MEET else None


def _settled(found: Sequence[Pieces], so_far: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """By how much a camera is off, `[7]`, as pieces tell that were looked for with `so_far` `[7]` of it put right; the inverse of its
    covariance, and how far off half of what they tell is left: least squares with Cauchy's weights, and a Gaussian prior."""
    by, off, told = (np.concatenate([getattr(pieces, kind) for pieces in found]) for kind in ("by", "off", "told"))
    values, vectors = np.linalg.eigh(told)
    along = vectors * np.sqrt(values.clip(0) / (values.clip(0) + TELLING))[:, None, :]
    terms, wanted = np.einsum("nab,nai->nbi", along, by).reshape(-1, 7), np.einsum("nab,na->nb", along, off).reshape(-1)
    prior = np.diag(1 / np.square(LIKELY))
    step = np.zeros(7)
    for _ in range(30):
        left = wanted - terms @ step
        spread = max(0.1, 1.5 * float(np.median(np.abs(left))))
        weight = 1 / (1 + (left / spread) ** 2) / spread**2 / (2 * OVERLAP)  # they overlap in the picture, and from pair to pair
        within = (terms * weight[:, None]).T @ terms + prior
        step = np.linalg.solve(within, (terms * weight[:, None]).T @ wanted - prior @ so_far)
    return so_far + step, within, float(np.median(np.abs(wanted - terms @ step)))


class _Look:
    """Pictures of a camera, as large as they are looked at, and what lidar measured then. street: by a sweep's place among `stamps`."""

    def __init__(self, log: Log, camera: LogCamera, stamps: np.ndarray, street: Callable[[int], tuple[Surfaces, np.ndarray]]):
        self.camera, self.stamps, self.street = camera, stamps, street
        self.width = min(WIDTH, camera.width)
        self.height = round(camera.height * self.width / camera.width)
        self.lens = camera.lens.scaled(self.width / camera.width, self.height / camera.height)

        @lru_cache(2 * PAIRS)
        def grey(index: int) -> np.ndarray:
            image = camera.image(index, self.width, self.height).astype(np.float32).mean(2)
            return image - ndimage.uniform_filter(image, SMOOTH)

        @lru_cache(2 * PAIRS)
        def speed(index: int) -> np.ndarray:
            time = int(camera.times_us[index])
            return (log.ego.near(time + 50_000) - log.ego.near(time - 50_000))[:3, 3].numpy() / 100_000

        @lru_cache(16 * PAIRS)
        def recorded(index: int, late_us: int) -> torch.Tensor:
            time = int(camera.times_us[index])
            return camera.world_from_cam[index] if not late_us else log.ego.near(time + late_us) @ offsets[index]

        offsets = inverse(log.ego.near_each(camera.times_us)) @ camera.world_from_cam
        self.grey, self.speed, self.recorded = grey, speed, recorded

    def pose(self, index: int, off: np.ndarray) -> torch.Tensor:
        """Where a frame was taken from, if its camera is off by so much `[7]`."""
        return self.recorded(index, round(float(off[6]) * 1e6)) @ small_poses(torch.from_numpy(off[:6]))

    def pieces(self, first: int, second: int, so_far: np.ndarray) -> Pieces | None:
        """Those of the first picture that the second one shows, too, looked for with `so_far` `[7]` put right; None where there are few."""
        sweep = int(np.abs(self.stamps - int(self.camera.times_us[first])).argmin())
        if abs(int(self.stamps[sweep]) - int(self.camera.times_us[first])) > SOON_US:
            return None
        spots, points, normals = self._chosen(self.pose(first, so_far), first, *self.street(sweep))
        if len(spots) < 2:
            return None
        side = np.arange(-HALF - REACH, HALF + REACH + 1)
        grid = spots[:, None, None] + np.stack(np.meshgrid(side, side), -1)
        carried = self._carried(first, second, grid, points, normals, so_far)
        core = carried[:, REACH:-REACH, REACH:-REACH]
        whole = ((core > 0) & (core < [self.width, self.height])).all((1, 2, 3))
        spots, points, normals, carried = spots[whole], points[whole], normals[whole], carried[whole]
        one = _sampled(self.grey(first), grid[whole][:, REACH:-REACH, REACH:-REACH])
        at, off, told = _found_again(one, _sampled(self.grey(second), carried))
        if not len(at):
            return None
        spots, points, normals, carried = spots[at], points[at], normals[at], carried[at]
        low, mid, high = (HALF + REACH + k for k in (-1, 0, 1))
        stretch = np.stack([carried[:, mid, high] - carried[:, mid, low], carried[:, high, mid] - carried[:, low, mid]], -1) / 2
        usable = np.abs(np.linalg.det(stretch)) > 0.05
        by, shown = [], []
        for small in np.diag([1e-4] * 6 + [1e-3]):
            ends = [so_far + small, so_far - small]
            ahead, behind = (self._carried(first, second, spots, points, normals, end) for end in ends)
            by.append((ahead - behind) / (2 * small.sum()))
            ahead, behind = (self.lens.project(_seen_from(self.pose(first, end), points)).numpy() for end in ends)
            shown.append((ahead - behind) / (2 * small.sum()) / self.lens.focal()[0])
        moves = np.linalg.solve(stretch[usable], np.stack(by, -1)[usable])
        return Pieces(moves, off[usable], told[usable], np.stack(shown, -1)[usable])

    def _chosen(self, pose: torch.Tensor, index: int, surfaces: Surfaces, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where in a picture taken from a pose pieces lie, `[N, 2]`, and the points and normals `[N, 3]` of the planes there."""
        local = _seen_from(pose, surfaces.points)
        depth = self.lens.depth(local).numpy()
        before = self.lens.valid(local).numpy() & (depth > NEAR) & (depth < FAR)
        points, normals, depth = surfaces.points[before], surfaces.normals[before], depth[before]
        spots = self.lens.project(local[before]).numpy()
        view = points - pose[:3, 3].numpy()
        slant = np.abs((view * normals).sum(1)) / np.linalg.norm(view, axis=1)
        seen = ((spots > HALF + 1) & (spots < np.array([self.width, self.height]) - HALF - 1)).all(1) & (slant > SLANTED)
        points, normals, depth, spots = points[seen], normals[seen], depth[seen], spots[seen]
        column, row = spots.astype(np.int64).T
        nearest = nearest_around(xyz, Camera(self.lens, self.width, self.height, pose), HALF // 2)
        grain = ndimage.uniform_filter(ndimage.gaussian_gradient_magnitude(self.grey(index), 1), HALF)[row, column]
        fine = np.flatnonzero((depth <= HIDING * nearest[row, column]) & (grain > GRAIN))
        best = fine[np.argsort(-grain[fine], kind="stable")]
        cells = (row[best] // APART) * self.width + column[best] // APART
        best = best[np.sort(np.unique(cells, return_index=True)[1])][:PIECES]
        return spots[best], points[best], normals[best]

    def _carried(self, first: int, second: int, pixels: np.ndarray, points: np.ndarray, normals: np.ndarray, off: np.ndarray) -> np.ndarray:
        """Where the second picture shows what the first one shows at pixels `[N, ..., 2]`, if it lies on planes through `points` `[N, 3]`,
        each seen as its row was read; far outside where it does not."""
        shape = pixels.shape[:-1]
        points, normals = (planes.reshape(-1, *[1] * (len(shape) - 1), 3) for planes in (points, normals))
        here, there = (self.pose(k, off).numpy() for k in (first, second))
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


def _found_again(pieces: np.ndarray, fields: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which of the pieces `[N, S, S]` their fields `[N, S + 2 REACH, S + 2 REACH]` show, indices `[K]`; pixels right and down of the
    middle `[K, 2]`, and by how much their likeness falls a pixel aside, `[K, 2, 2]`: the second derivatives of the weighted correlation."""
    count, side = len(pieces), fields.shape[-1]
    window = np.hanning(pieces.shape[-1] + 2)[1:-1]
    window = window[:, None] * window
    window /= window.sum()

    def over(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        spectra = [np.fft.rfft2(x, (side, side)) for x in (a, b)]
        return np.fft.irfft2(spectra[0] * spectra[1].conj(), (side, side))[:, : 2 * REACH + 1, : 2 * REACH + 1]

    means = (pieces * window).sum((1, 2), keepdims=True)
    plain = pieces - means
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
