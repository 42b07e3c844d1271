"""Corrects the height and tilt of cameras by the road: what their pictures show of it must meet on the ground.

A mount that is off by centimetres hardly shows in what stands upright. But a picture projected onto the ground with it (inverse perspective
mapping, Mallot et al. 1991) is off by as many percent of its distance as the camera's height is, so that a line seen from 13 m lies
elsewhere than from 10 m. Splats compensate by being thick, at angles that look right from the recorded path, and from beside it a painted
dash becomes a fir. Here the same pieces of bare road are projected from pairs of pictures, one taken a few metres after the other, and
correlated. Tilt has nearly the effect of a wrong height, but one that grows with distance; what remains open is settled by a prior of how
large errors of mounts are likely to be.
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

from recon.ground import above_ground, estimate_ground
from recon.log import Log, LogCamera, Sweep
from recon.registration.corrected import REMOUNTED, as_corrected
from scenes.ground import Ground

WAY, WITHIN_US = 2.5, 3_000_000
"""Metres between the pictures of a pair, which are no farther apart in time."""

PAIRS, FEWEST = 30, 12
"""Of a camera, spread over the drive; and how many pieces must have met for its mount to be told."""

AHEAD, LOWEST = (3.0, 4.5, 6.0, 7.5), 0.5
"""Heights of the camera above the ground at which the pieces of road lie that are laid out, along its view; and metres that it must be
above the ground for them to be what it shows."""

HALF, MARGIN, STEP = 1.5, 0.3, 0.03
"""Metres: half the sides of a piece, how much around it has to be free, and between its points."""

SMOOTH = 10
"""Points over which a piece's brightness is evened out."""

STANDS, FEW, OWN = 0.3, 2, 2.0
"""Metres above the ground from which on a lidar point stands there, how many may, between a camera and the far side of a piece, and how
near the camera they are the recording car's."""

NEAR, SOON_US = 30.0, 150_000
"""Metres from the body up to which a sweep is asked, and how far in time it may be from a picture."""

ALIKE = 0.25
"""Correlation from which on two pictures show the same."""

OFF = 0.1
"""Part of its height that a camera may be off: a piece is looked for as far away."""

PLACE, TILT = 0.03, 1.0
"""Metres by which a mount is likely to be off, and pixels by which it is to be tilted: what cameras are calibrated to."""

OVERLAP = 4.0
"""Pieces lie on one another and err alike: so many count as one."""

LEAST, SURE = 0.02, 3.0
"""Metres from which on what pieces tell in the mean is corrected, and standard errors that it has to differ by."""


@dataclass(frozen=True)
class Street:
    """What sweeps tell of a street: its ground, and by a moment what was seen near the body then, `[N, 3]`."""

    ground: Ground
    seen: dict[int, np.ndarray]

    @staticmethod
    def of(log: Log, sweeps: Sequence[Sweep], times_us: np.ndarray, span_us: tuple[int, int]) -> Street | None:
        """By those of the sweeps that are nearest to the moments; None where there is none."""
        stamps = np.array([sweep.time_us for sweep in sweeps], dtype=np.int64)
        chosen = {int(np.abs(stamps - time).argmin()) for time in times_us} if len(stamps) else set()
        seen = {}
        for i in sorted(chosen):
            xyz = sweeps[i].read().xyz
            seen[int(stamps[i])] = xyz[np.linalg.norm(xyz - log.ego.near(int(stamps[i]))[:3, 3].numpy(), axis=1) < NEAR]
        points = np.concatenate([*seen.values(), np.zeros((0, 3))])
        return Street(estimate_ground(points, log.ego.within(span_us)), seen) if len(points) else None

    def above(self, xyz: np.ndarray) -> np.ndarray:
        """Metres `[...]` above the ground."""
        return above_ground(xyz, self.ground)

    def bare(self, eye: np.ndarray, middle: np.ndarray, time_us: int) -> bool:
        """Whether nothing stands at a moment between an eye `[3]` and the far side of a piece of road about a point `[3]`."""
        stamp = min(self.seen, key=lambda stamp: abs(stamp - time_us))
        if abs(stamp - time_us) > SOON_US:
            return False
        way = middle[:2] - eye[:2]
        far = float(np.linalg.norm(way))
        ahead, xyz = way / far, self.seen[stamp]
        along, across = ((xyz[:, :2] - eye[:2]) @ np.stack([ahead, [-ahead[1], ahead[0]]], 1)).T
        xyz = xyz[(along > OWN) & (along < far + HALF + MARGIN) & (np.abs(across) < HALF + MARGIN)]
        off = self.above(xyz)
        return bool(((off > STANDS) & (off < float(self.above(eye)) + STANDS)).sum() <= FEW)


def mounts_by_road(
    log: Log, names: Sequence[str], sweeps: Sequence[Sweep], span_us: tuple[int, int], report: Callable[[], None] = lambda: None
) -> Log:
    """The log with those of the cameras `names` moved up or down and tilted whose pictures of the road, in a span, show that they are
    elsewhere than recorded, as `meta` then says; as it is where none do, or where `sweeps` do not tell the ground. All pictures of the span
    count, also those that a fit holds out, as for the path. `report` is called for each camera."""
    pairs = {name: far_pairs(log.camera(name), span_us) for name in names}
    times = [log.camera(name).times_us[k] for name in names for pair in pairs[name] for k in pair]
    street = Street.of(log, sweeps, np.array(times, dtype=np.int64), span_us)
    if street is None:
        return log
    found = {}
    for name in names:
        if off := _off(log, log.camera(name), pairs[name], street):
            (metres, radians), found[name] = off, off
            moved = f"{100 * abs(metres):.1f} cm {'higher' if metres > 0 else 'lower'}"
            turned = f"{1e3 * abs(radians):.1f} mrad farther {'up' if radians > 0 else 'down'}"
            print(f"{log.path}: {name} is taken {moved} and {turned} than recorded, where its pictures of the road meet", file=sys.stderr)
        report()
    return as_corrected(log, {REMOUNTED: found}) if found else log


def far_pairs(camera: LogCamera, span_us: tuple[int, int], most: int = PAIRS, way: float = WAY) -> list[tuple[int, int]]:
    """Indices of pictures of the span, and of the first taken a `way` further on; `most` of them, spread over it."""
    times, places = camera.times_us.numpy(), camera.world_from_cam[:, :2, 3].numpy()
    chosen = np.flatnonzero((times >= span_us[0]) & (times <= span_us[1]))
    pairs = []
    for i in chosen:
        later = chosen[(chosen > i) & (times[chosen] - times[i] <= WITHIN_US)]
        far = later[np.linalg.norm(places[later] - places[i], axis=1) >= way]
        if len(far):
            pairs.append((int(i), int(far[0])))
    return [pairs[k] for k in np.unique(np.linspace(0, len(pairs) - 1, most).round().astype(int))] if pairs else []


def _off(log: Log, camera: LogCamera, pairs: Sequence[tuple[int, int]], street: Street) -> tuple[float, float] | None:
    """Metres by which a camera stands higher than recorded, and radians by which it looks farther up; None where its pictures do not tell,
    or meet."""

    @lru_cache(2 * PAIRS)
    def grey(index: int) -> np.ndarray:
        return camera.image(index).mean(2).astype(np.uint8)

    pieces = (_apart(log, camera, *pair, ahead, grey, street) for pair in pairs for ahead in AHEAD)
    told = [piece for piece in pieces if piece is not None]
    if len(told) < FEWEST:
        return None
    lever, off = np.array(told).T
    return _settled(lever, off, TILT / camera.lens.focal()[1])


def _settled(lever: np.ndarray, off: np.ndarray, tilt: float) -> tuple[float, float] | None:
    """The likeliest height and tilt of which pieces tell `off` `[N]` metres of height, or as many per `lever` `[N]` radians of tilt, where
    `tilt` is likely; None where they may as well be as recorded. Least squares with Cauchy's weights, and Gaussian priors."""
    terms = np.stack([np.ones_like(lever), lever], 1)
    prior = np.diag([1 / PLACE**2, 1 / tilt**2])
    weight = np.ones_like(off)
    for _ in range(20):
        best = np.linalg.solve((terms * weight[:, None]).T @ terms / OVERLAP + prior, (terms * weight[:, None]).T @ off / OVERLAP)
        left = off - terms @ best
        spread = max(2e-3, 1.5 * float(np.median(np.abs(left))))
        weight = 1 / (1 + (left / spread) ** 2) / spread**2
    mean, error = float((weight * off).sum() / weight.sum()), math.sqrt(OVERLAP / weight.sum())
    return (float(best[0]), float(best[1])) if abs(mean) >= max(LEAST, SURE * error) else None


def _apart(
    log: Log, camera: LogCamera, first: int, second: int, ahead: float, grey: Callable[[int], np.ndarray], street: Street
) -> tuple[float, float] | None:
    """By how many metres of height a radian of tilt moves a piece of road that two pictures of a camera show, and how much higher it would
    stand by the piece alone; None where they do not show the same."""
    eyes = [camera.world_from_cam[i, :3, 3].numpy() for i in (first, second)]
    view, height = camera.world_from_cam[second, :2, 2].numpy(), float(street.above(eyes[1]))
    if height < LOWEST:
        return None
    view = view / max(1e-6, float(np.linalg.norm(view)))
    middle = np.append(eyes[1][:2] + ahead * height * view, 0.0)
    if not all(street.bare(eye, middle, int(camera.times_us[i])) for eye, i in zip(eyes, (first, second), strict=True)):
        return None
    way = float(np.linalg.norm(eyes[1][:2] - eyes[0][:2]))
    forward = (eyes[1][:2] - eyes[0][:2]) / way
    u = np.arange(-HALF, HALF, STEP)
    x, y = np.meshgrid(u, u, indexing="ij")
    spots = middle[:2] + x[..., None] * forward + y[..., None] * [-forward[1], forward[0]]
    spots = np.concatenate([spots, street.ground.height(torch.from_numpy(spots)).numpy()[..., None]], 2)
    one = laid_out(log, camera, first, grey, spots)
    other = None if one is None else laid_out(log, camera, second, grey, spots)
    if one is None or other is None:
        return None
    shift = _shift(one, other, math.ceil(OFF * (way + height) / STEP))
    far = float(np.mean([np.linalg.norm(middle[:2] - eye[:2]) for eye in eyes]))
    lever = far * (1 + float(view @ forward) ** 2)  # tilted, a piece moves by the square of its distance; aside, by its bearing
    return None if shift is None else (lever, -height * shift * STEP / (way + shift * STEP))


def laid_out(log: Log, camera: LogCamera, index: int, grey: Callable[[int], np.ndarray], spots: np.ndarray) -> np.ndarray | None:
    """What a picture shows at spots `[X, Y, 3]` of the ground, seen from where the camera was as their rows were read, by its `grey` levels
    of any size; None where it does not show all."""
    pose, time = camera.world_from_cam[index].numpy(), int(camera.times_us[index])
    speed = (log.ego.near(time + 50_000) - log.ego.near(time - 50_000))[:3, 3].numpy() / 100_000
    late = np.zeros((*spots.shape[:2], 1))
    for _ in range(2):
        local = torch.from_numpy((spots - pose[:3, 3] - speed * late) @ pose[:3, :3]).reshape(-1, 3)
        if not bool((camera.lens.valid(local) & (camera.lens.depth(local) > 0)).all()):
            return None
        column, row = camera.lens.project(local).numpy().reshape(*spots.shape[:2], 2).transpose(2, 0, 1)
        if row.min() < 0 or column.min() < 0 or row.max() > camera.height or column.max() > camera.width:
            return None
        late = camera.late_us(column / camera.width, row / camera.height)[..., None]
    image = grey(index).astype(np.float32)
    rows, columns = (n / size for n, size in zip(image.shape, (camera.height, camera.width), strict=True))
    return ndimage.map_coordinates(image, [row * rows - 0.5, column * columns - 0.5], order=1, mode="nearest")


def _shift(one: np.ndarray, other: np.ndarray, most: int) -> float | None:
    """Points by which what `one` `[X, Y]` shows lies farther along x than in `other`, at most `most`; None where they are not alike.

    The peak of their correlation, to a part of a point by the parabola through it."""
    window = np.hanning(len(one))[:, None] * np.hanning(one.shape[1])
    a, b = ((image - ndimage.gaussian_filter(image, SMOOTH)) * window for image in (one, other))
    likeness = np.fft.irfft2(np.fft.rfft2(a) * np.fft.rfft2(b).conj(), one.shape) / max(1e-9, float(np.linalg.norm(a) * np.linalg.norm(b)))
    near = np.roll(likeness, (most, 2), (0, 1))[: 2 * most + 1, :5]  # across the way they lie as recorded, but for a few centimetres
    at, aside = np.unravel_index(near.argmax(), near.shape)
    if near[at, aside] < ALIKE or not 0 < at < 2 * most:
        return None
    before, peak, after = near[at - 1 : at + 2, aside]
    return float(at - most + 0.5 * (before - after) / min(-1e-9, before - 2 * peak + after))
