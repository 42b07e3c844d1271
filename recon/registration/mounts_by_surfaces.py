"""Corrects mounts and clocks of cameras by lidar's surfaces: what one picture shows on them must be where the next one shows it.

With a mount that is off by half a degree, every surface gets the colours from beside it, and a fit begins with splats of wrong colours at
right places, or of right colours at wrong ones. Patches of a picture are found again in one that was taken a few metres further on
(patches.py). How far a patch moves between the two depends on where its plane is relative to the camera, so planes near and far, to all
sides, together determine the six parameters of the mount and the delay of the clock (Gauss-Newton with a prior of how large errors are
likely to be). This needs neither lidar intensities nor road markings. What patches do not determine, as the camera's place along a straight
road, stays as recorded; changes of speed and turns tell that place from a delay.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np

from recon.log import Log, Sweep
from recon.objects.actors import SWEPT_MARGIN, inside
from recon.registration.align import FARTHEST, Surfaces
from recon.registration.corrected import TURNED, as_corrected
from recon.registration.mounts_by_road import OVERLAP, far_pairs
from recon.registration.patches import CameraPictures, Matches
from scenes.trajectory import all_near

PAIRS = 16
"""Pairs of pictures a camera, spread over the span."""

LIKELY = (0.005, 0.005, 0.005, 0.05, 0.05, 0.05, 0.01)
"""Standard deviations of the prior: of the mount in radians and metres, of the clock in seconds."""

FEWEST, ROUNDS = 150, 4
"""Matches that determine a camera's mount at least, and rounds of searching and solving at most."""

LEAST, SURE = 0.009, 8.0
"""Mean shift in radians of what pictures show from which on a mount is corrected, and how many standard errors it must be. A fit copes with
less by itself, and what is found then depends on the span."""

DONE = 0.0003
"""Change of that shift, in radians, below which no further round is needed."""

MEET = 0.35
"""Largest median residual in pixels once the mount is corrected: above it something else is wrong."""

TELLING = 0.02
"""Curvature of the correlation from which on a match's offset counts fully."""

BELOW = 0.1
"""Metres below a mover's box whose points belong to it."""


def mounts_by_surfaces(
    log: Log, names: Sequence[str], sweeps: Sequence[Sweep], span_us: tuple[int, int], report: Callable[[], None] = lambda: None
) -> Log:
    """The log with corrected mounts and clocks of those of the cameras `names` whose pictures in a span do not agree with the surfaces of
    `sweeps`; `meta` then has the corrections. The same log where all agree. All pictures of the span count, also those that a fit holds
    out, as for the path. `report` is called for each camera.
    """

    @lru_cache(PAIRS)
    def street(sweep: int) -> tuple[Surfaces, np.ndarray]:
        return _standing(log, sweeps[sweep])

    stamps = np.array([sweep.time_us for sweep in sweeps], dtype=np.int64)
    found = {}
    for name in names:
        camera = log.camera(name)
        pictures = CameraPictures(log, camera, stamps, street, PAIRS)
        off = _error(pictures, far_pairs(camera, span_us, PAIRS)) if len(sweeps) else None
        if off is not None:
            found[name] = off.tolist()
            degrees, metres = math.degrees(float(np.linalg.norm(off[:3]))), float(np.linalg.norm(off[3:6]))
            moved = f"turned by {degrees:.2f} degrees, moved by {100 * metres:.1f} cm and {1e3 * off[6]:+.0f} ms later"
            print(f"{log.path}: {name} is taken {moved} than recorded, where surfaces meet in its pictures", file=sys.stderr)
        report()
    return as_corrected(log, {TURNED: found}) if found else log


def _standing(log: Log, sweep: Sweep) -> tuple[Surfaces, np.ndarray]:
    """Planes and points `[N, 3]` of a sweep without those of annotated movers."""
    xyz, body = sweep.read().xyz, log.ego.near(sweep.time_us)[:3, 3].numpy()
    xyz = xyz[np.linalg.norm(xyz - body, axis=1) < FARTHEST]
    movers = [t for t in log.tracks if t.moving and t.times_us[0] <= sweep.time_us <= t.times_us[-1]]
    for track, pose in zip(movers, all_near([t.trajectory() for t in movers], sweep.time_us) if movers else (), strict=True):
        turn, place = pose[:3, :3].numpy(), pose[:3, 3].numpy()
        xyz = xyz[~inside((xyz - place) @ turn, track.size, SWEPT_MARGIN, BELOW)]
    return Surfaces.of(xyz, body), xyz


def _error(pictures: CameraPictures, pairs: Sequence[tuple[int, int]]) -> np.ndarray | None:
    """The error `[7]` of a camera's mount and clock (`Matches`); None where its pictures do not determine one, or it is too small."""
    error, before = np.zeros(7), 0.0
    for _ in range(ROUNDS):
        found = [matches for i, j in pairs if (matches := pictures.matches(i, j, error)) is not None]
        if sum(len(matches.offset) for matches in found) < FEWEST:
            return None
        error, information, residual = _improved(found, error)
        shifts = np.concatenate([matches.own_jacobian for matches in found]) @ error
        shift = math.sqrt(float(np.square(shifts).sum(1).mean()))
        if shift < LEAST / 2 or abs(shift - before) < DONE:
            break
        before = shift
    return error if shift >= LEAST and float(error @ information @ error) > SURE**2 and residual < MEET else None


def _improved(found: Sequence[Matches], error: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """The error `[7]` after a Gauss-Newton step from the one that the matches were searched with, the inverse of its covariance `[7, 7]`,
    and the median residual in pixels. Least squares with Cauchy's weights, and a Gaussian prior."""
    kinds = ("jacobian", "offset", "curvature")
    jacobian, offset, curvature = (np.concatenate([getattr(matches, kind) for matches in found]) for kind in kinds)
    values, vectors = np.linalg.eigh(curvature)
    along = vectors * np.sqrt(values.clip(0) / (values.clip(0) + TELLING))[:, None, :]
    terms, wanted = np.einsum("nab,nai->nbi", along, jacobian).reshape(-1, 7), np.einsum("nab,na->nb", along, offset).reshape(-1)
    prior = np.diag(1 / np.square(LIKELY))
    step = np.zeros(7)
    for _ in range(30):
        left = wanted - terms @ step
        spread = max(0.1, 1.5 * float(np.median(np.abs(left))))
        weight = 1 / (1 + (left / spread) ** 2) / spread**2 / (2 * OVERLAP)  # they overlap in the picture, and from pair to pair
        information = (terms * weight[:, None]).T @ terms + prior
        step = np.linalg.solve(information, (terms * weight[:, None]).T @ wanted - prior @ error)
    return error + step, information, float(np.median(np.abs(wanted - terms @ step)))
