"""What moves along the street, as a picture tells it together with some from before and after: cars ahead, oncoming and overtaking ones.

A thing that goes along with the camera looks like a standing one elsewhere: farther away and larger where it goes our way, nearer and
smaller where it comes. But it stands on the ground, and what it hides of that tells where. So each place on the ground is asked whether
what stands there looks alike in all pictures if it moves, and more so than anything that stands still could; and whether the ground before
it is seen (a plane sweep, Collins 1996, over places and speeds).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from recon.seeds.dense import FARTHEST, ground_depth
from recon.seeds.stereo import WINDOW, Plate, box_means, unlike
from scenes.ground import Ground

DISTANCES = 4.5 * 1.09 ** np.arange(27)
"""Metres ahead at which things are looked for, up to 42; what seems to be at the last may be farther."""

ONCOMING, PASSING = 20, 12
"""Metres a second at which things come towards us at most, and by which they go faster than we do."""

SLOWEST = 1.5
"""Metres a second from which on something is believed to move."""

REAR = 1.7, 1.3
"""Metres across and up that are looked at together: a car's rear but for its roof, through whose windows the street is seen."""

BEFORE = 0.7
"""Metres of the ground before it that must be seen, as high as it would be if it stood there."""

STANDING = 40, (4.0, 120.0)
"""Depths, in equal steps of their inverse, at which what stands still may be."""

UNDER, NEARER = 0.87, 1.12
"""Parts of its inverse depth by which what stands still may be under the ground, and nearer than the place that is asked about."""

WORTH, GROUNDED = 0.07, 0.04
"""By how much a thing must look more alike than what stands still, and the ground before it than if the thing went on there."""

APART = 0.6
"""Of a rear's width: two things in a picture are that far apart at least."""


@dataclass(frozen=True)
class Sighting:
    """Something that moves, in a picture at `time_us`: where the middle of what is seen of it stands `[2]`, the street's direction there
    `[2]`, how far ahead of the camera that is, and its speed along the street in m/s; by how much it looks more alike than what stands
    still, `worth`, and the ground before it than if it went on there, `grounded`. cut: whether the picture's border is so near that there
    may be more of it beyond."""

    time_us: int
    place: np.ndarray
    along: np.ndarray
    away: float
    speed: float
    worth: float
    grounded: float
    cut: bool


def sightings(
    plate: Plate, time_us: int, sides: Sequence[Sequence[tuple[Plate, int]]], ground: Ground, path: np.ndarray, pace: float
) -> list[Sighting]:
    """What moves in a plate taken at a time, best first. sides: plates of its size before it, and after it, with their times; path:
    places `[N, 2]` of the body, in order, each some way from the last; pace: its speed then."""
    if not sides:
        return []
    eye, speeds = plate.eye(), np.arange(-ONCOMING, pace + PASSING, 1.0)
    still = [[(other, np.zeros((1, 3))) for other, _ in side] for side in sides]
    deepest = np.minimum(ground_depth(plate, ground, 0.0), FARTHEST)
    inverse_depths = torch.linspace(1 / STANDING[1][1], 1 / STANDING[1][0], STANDING[0])
    standing = torch.cat([box_means(unlike(plate, still, slice(None), 1 / float(w))) for w in inverse_depths])
    of_ground = box_means(unlike(plate, still, slice(None), torch.from_numpy(deepest).float()))[0].numpy()
    found = []
    for z in DISTANCES:
        base = _base(plate, ground, z)
        rows = slice(max(0, round(base - REAR[1] * plate.focal[1] / z)), round(base + BEFORE * plate.focal[1] / z) + 1 + WINDOW // 2)
        bottom = round(base) - rows.start
        before = slice(bottom + WINDOW // 2, None)  # squares around pixels next to a thing show it, too
        if bottom < WINDOW or len(of_ground[rows][before]) < 2:
            continue
        along = _along(path, eye[:2] + z * plate.axis()[:2])
        ways = [[(other, np.outer(speeds * (t - time_us) / 1e6, [*along, 0.0])) for other, t in side] for side in sides]
        moving = unlike(plate, ways, rows, float(z)).numpy()
        allowed = (inverse_depths[:, None, None] <= NEARER / z) & (inverse_depths[:, None, None] >= UNDER / torch.from_numpy(deepest[rows]))
        stands = np.minimum(torch.where(allowed, standing[:, rows], torch.inf).amin(0).numpy(), of_ground[rows])
        across = max(1, round(REAR[0] * plate.focal[0] / z))
        as_mover = _beside(moving[:, :bottom].mean(1), across)
        best, column = as_mover.argmin(0), np.arange(len(stands[0]))
        worth = _beside(stands[:bottom].mean(0), across) - as_mover[best, column]
        grounded = _beside((moving[:, before] - of_ground[rows][before]).mean(1), across)[best, column]
        fits = (worth > WORTH) & (grounded > GROUNDED) & (np.abs(speeds[best]) >= SLOWEST)
        for x in np.flatnonzero(fits):
            ray = np.array([(x + 0.5 - plate.centre[0]) / plate.focal[0], 0.0, 1.0]) @ plate.cam_from_world[:3, :3]
            cut = not across < x < len(stands[0]) - across
            told = float(z), float(speeds[best[x]]), float(worth[x]), float(grounded[x])
            one = Sighting(time_us, (eye + z * ray)[:2], along, *told, cut)
            found.append((float(worth[x] + min(grounded[x], worth[x])), int(x), across, z, one))
    kept: list[tuple[float, int, int, float, Sighting]] = []
    for new in sorted(found, key=lambda f: -f[0]):
        if all(abs(new[1] - old[1]) > APART * max(new[2], old[2]) for old in kept):
            kept.append(new)
    return [one for *_, z, one in kept if z < DISTANCES[-1]]


def _base(plate: Plate, ground: Ground, z: float) -> float:
    """The row at which what is z ahead stands, in the median over the columns."""
    x = (np.arange(0, plate.grey.shape[1], 8) + 0.5 - plate.centre[0]) / plate.focal[0]
    at = plate.eye() + z * np.stack([x, np.zeros_like(x), np.ones_like(x)], 1) @ plate.cam_from_world[:3, :3]
    at[:, 2] = ground.height(torch.from_numpy(at[:, :2].copy())).numpy()
    local = (at - plate.eye()) @ plate.cam_from_world[:3, :3].T
    return float(np.median(local[:, 1] / local[:, 2] * plate.focal[1] + plate.centre[1]))


def _along(path: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The unit direction `[2]` of a path where it is nearest to a place."""
    nearest = int(np.linalg.norm(path - place, axis=1).argmin())
    way = path[min(nearest + 1, len(path) - 1)] - path[max(nearest - 1, 0)]
    return way / np.linalg.norm(way)


def _beside(costs: np.ndarray, across: int) -> np.ndarray:
    """Means of `[..., w]` over so many columns."""
    return ndimage.uniform_filter1d(costs, across | 1, axis=-1, mode="nearest")
