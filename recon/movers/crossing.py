"""What crosses: whoever goes across the line of sight, walking or driving, as a picture tells it together with one from before and one from
after.

What stands still moves along its ray's epipolar line as we go on, and not at all while we wait: a thing that goes sideways does not. So
each place on the ground is asked whether what stands there looks alike in all pictures if it moves sideways, and more so than anything that
stands still, as in `sighting.py`. Neither its size nor its kind is known: it reaches as far as it looks so much more alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from recon.movers.sighting import BEFORE, DISTANCES, STANDING, Sighting, base_row, beside, outline, shown_at
from recon.seeds.dense import FARTHEST, ground_depth
from recon.seeds.stereo import WINDOW, Plate, box_means
from recon.seeds.ways import at_rest, unlike
from scenes.ground import Ground

Sides = Sequence[Sequence[tuple[Plate, int]]]
"""Plates before one, and after it, with the times at which they were taken."""

LEVEL = 0.3
"""Part of a camera's axis that must be level: of one that looks down nobody knows what goes sideways."""

FASTEST, SLOWEST = 12.0, 0.7
"""Metres a second sideways, at most and at least."""

STEP, FINER = 2.0, 4
"""Pixels by which the speeds that are asked take a thing elsewhere, and into how many each such step is divided at last."""

BODY = 0.5, 1.3
"""Metres across and up that are looked at together: a walker's trunk and legs."""

WORTH, GROUNDED = 0.2, 0.1
"""By how much a thing must look more alike than what stands still, and the ground before it than if the thing went on there: more than is
asked of what goes along the street, since more is tried."""

NARROWEST = 4
"""Columns that a thing must show."""

LOOSE, LOWER = 0.12, 0.85
"""By how much what is below a thing must look less like anything that stands still than what is beside it, to be the rest of it, and the
part of its distance at which the foot of that must stand, at most: legs swing, and look like no part of a body that goes steadily."""

ONE = 0.25, 0.8, 2.5
"""Part of the distance, metres between ends, and metres a second by which two parts of one thing may differ: pillars and wheels look more
alike than doors."""


@dataclass(frozen=True)
class _Found:
    """What columns around x show in `rows`, `away` metres ahead: how fast it goes to the left, by how much it looks more alike than what
    stands still, `worth`, of all columns `worths` `[w]`, and the ground before it, `grounded`."""

    x: int
    rows: slice
    away: float
    speed: float
    worth: float
    grounded: float
    worths: np.ndarray

    @property
    def score(self) -> float:
        return self.worth + min(self.grounded, self.worth)


def crossings(plate: Plate, time_us: int, sides: Sides, ground: Ground) -> list[Sighting]:
    """What crosses a plate taken at a time, best first. sides: as of `sightings`, of which the nearest of each is asked: who walks looks
    another half a second later. Nothing where the camera looks up or down."""
    sides = [side[:1] for side in sides]
    if not sides or np.linalg.norm(plate.axis()[:2]) < LEVEL:
        return []
    deepest = np.minimum(ground_depth(plate, ground, 0.0), FARTHEST)
    of_ground = box_means(unlike(plate, at_rest(sides), slice(None), torch.from_numpy(deepest).float()))[0]
    inverse_depths = np.linspace(1 / STANDING[1][1], 1 / STANDING[1][0], STANDING[0])
    stands = torch.minimum(of_ground, box_means(unlike(plate, at_rest(sides, STANDING[0]), slice(None), 1 / inverse_depths)).amin(0))
    bases = np.array([base_row(plate, ground, z) for z in DISTANCES])
    costs = stands.numpy(), of_ground.numpy()
    found = [new for z, base in zip(DISTANCES[:-1], bases, strict=False) for new in _at(plate, time_us, sides, float(z), base, *costs)]
    kept: list[Sighting] = []
    taken = np.zeros(plate.grey.shape[1], bool)
    for new in sorted(found, key=lambda f: -f.score):
        if taken[new.x]:
            continue
        half = max(1, round(BODY[0] * plate.focal[0] / new.away) // 2)
        shown = slice(max(0, new.x - half), new.x + half + 1)
        first, last = outline(new.worths, shown)
        taken[max(0, min(first, shown.start) - half) : max(last, shown.stop) + half + 1] = True
        if last - first + 1 >= NARROWEST:
            columns = slice(first, last + 1)
            on_foot = _on_its_foot(new, columns, costs[0], bases)
            kept.append(_sighting(plate, time_us, sides, on_foot, columns, costs[0]))
    return _joined(kept, plate.eye()[:2])


def _joined(seen: Sequence[Sighting], eye: np.ndarray) -> list[Sighting]:
    """Sightings of one picture, best first, those of one thing's parts as one."""
    things: list[Sighting] = []
    for one in seen:
        for i, other in enumerate(things):
            if _one(one, other):
                things[i] = _around(other, one, eye)
                break
        else:
            things.append(one)
    return things


def _one(a: Sighting, b: Sighting) -> bool:
    """Whether two are parts of one thing."""
    assert a.ends is not None and b.ends is not None
    if abs(a.away - b.away) > ONE[0] * min(a.away, b.away) or np.abs(a.velocity - b.velocity).max() > ONE[2]:
        return False
    left = np.array([a.axes[1] @ end for end in (*a.ends, *b.ends)])
    return bool(max(left[1] - left[2], left[3] - left[0]) < ONE[1])


def _around(best: Sighting, other: Sighting, eye: np.ndarray) -> Sighting:
    """The better of two sightings, from the outer end of either to that of the other, as far away as the better one is."""
    assert best.ends is not None and other.ends is not None
    scale = [1.0, 1.0, best.away / other.away, best.away / other.away]
    ends = [eye + k * (end - eye) for k, end in zip(scale, (*best.ends, *other.ends), strict=True)]
    left = [float(best.axes[1] @ end) for end in ends]
    first, last = int(np.argmax(left)), int(np.argmin(left))
    cuts = best.cuts[0] or other.cuts[0], best.cuts[1] or other.cuts[1]
    high = max(best.high, other.high * scale[2])
    return _turned(replace(best, ends=np.stack([ends[first], ends[last]]), cuts=cuts, cut=any(cuts), high=high), eye)


def _turned(one: Sighting, eye: np.ndarray) -> Sighting:
    """A sighting that is where its ends are, along the line of sight to there."""
    assert one.ends is not None
    middle = one.ends.mean(0) - eye
    away = float(np.linalg.norm(middle))
    along = middle / away
    speed, aside = np.array([along, [-along[1], along[0]]]) @ one.velocity
    return replace(one, place=eye + middle, along=along, away=away, speed=float(speed), aside=float(aside))


def _left(plate: Plate) -> np.ndarray:
    """The direction `[3]` in plan to the left of a plate's axis."""
    ahead = plate.axis()[:2] / np.linalg.norm(plate.axis()[:2])
    return np.array([-ahead[1], ahead[0], 0.0])


def _moved(plate: Plate, time_us: int, sides: Sides, speeds: np.ndarray) -> list[list[tuple[Plate, np.ndarray]]]:
    """Where what goes to the left at speeds `[N]` is when the others were taken: as `unlike` takes it."""
    return [[(other, np.outer(speeds * (t - time_us) / 1e6, _left(plate))) for other, t in side] for side in sides]


def _step(plate: Plate, time_us: int, sides: Sides, z: float) -> float:
    """Metres a second that take what is z ahead `STEP` pixels elsewhere until another picture."""
    return STEP * z / plate.focal[0] / max(abs(t - time_us) / 1e6 for side in sides for _, t in side)


def _at(plate: Plate, time_us: int, sides: Sides, z: float, base: float, stands: np.ndarray, of_ground: np.ndarray) -> list[_Found]:
    """What crosses z metres ahead, where things stand at the row `base`. stands, of_ground: what it costs in each pixel that something
    stands still, or is the ground."""
    rows = slice(max(0, round(base - BODY[1] * plate.focal[1] / z)), round(base + BEFORE * plate.focal[1] / z) + 1 + WINDOW // 2)
    bottom = round(base) - rows.start
    before, rims = slice(bottom + WINDOW // 2, None), slice(bottom + WINDOW // 2)
    across = max(1, round(BODY[0] * plate.focal[0] / z))
    if bottom < WINDOW or len(of_ground[rows][before]) < 2:
        return []
    # no speed can be worth more than standing costs
    hope = np.flatnonzero(beside(stands[rows][rims].mean(0), across) > WORTH)
    if not len(hope):
        return []
    columns = slice(max(0, hope[0] - across - WINDOW), hope[-1] + across + WINDOW + 1)
    part = plate.columns(columns)
    step = _step(plate, time_us, sides, z)
    speeds = np.arange(step * np.ceil(SLOWEST / step), FASTEST, step)
    speeds = np.concatenate([-speeds[::-1], speeds])
    if not len(speeds):
        return []
    moving = unlike(part, _moved(plate, time_us, sides, speeds), rows, z).numpy()
    worths = np.zeros((len(speeds), len(stands[0])))
    worths[:, columns] = stands[rows, columns][rims].mean(0) - moving[:, rims].mean(1)
    smooth = beside(worths, across)
    best = smooth.argmax(0)
    grounded = np.zeros_like(worths)
    grounded[:, columns] = (moving[:, before] - of_ground[rows, columns][before]).mean(1)
    grounded = beside(grounded, across)
    fits = [x for x in range(len(best)) if smooth[best[x], x] > WORTH and grounded[best[x], x] > GROUNDED]
    return [
        _Found(x, slice(rows.start, rows.start + bottom), z, float(speeds[k]), float(smooth[k, x]), float(grounded[k, x]), worths[k])
        for x in fits
        for k in (best[x],)
    ]


def _on_its_foot(found: _Found, columns: slice, stands: np.ndarray, bases: np.ndarray) -> _Found:
    """What was found in columns, at the distance at which its lowest part stands. stands: what it costs in each pixel that something stands
    still; bases: rows at which things stand at `DISTANCES`."""
    loose = beside(stands[:, columns].mean(1) - np.median(stands, axis=1), WINDOW)
    firm = np.flatnonzero(loose[found.rows.stop :] < LOOSE)
    foot = found.rows.stop + firm[0] if len(firm) else len(loose)
    horizon, drop = np.polynomial.polynomial.polyfit(1 / DISTANCES, bases, 1)
    away = drop / max(foot - horizon, 1.0)
    if not 0 < away < LOWER * found.away:
        return found
    return replace(found, away=float(away), speed=float(found.speed * away / found.away))


def _sighting(plate: Plate, time_us: int, sides: Sides, found: _Found, columns: slice, stands: np.ndarray) -> Sighting:
    """A thing that columns show, at the speed that fits these best, and as high as it looks more alike so. stands: what it costs in each
    pixel that something stands still."""
    part = plate.columns(columns)
    speeds = found.speed + _step(plate, time_us, sides, found.away) * np.linspace(-1, 1, 2 * FINER + 1)
    costs = unlike(part, _moved(plate, time_us, sides, speeds), found.rows, found.away).mean((1, 2)).numpy()
    speed, above = float(speeds[costs.argmin()]), slice(0, found.rows.stop)
    moving = unlike(part, _moved(plate, time_us, sides, np.array([speed])), above, found.away)[0].numpy()
    worths = beside((stands[above, columns] - moving).mean(1), WINDOW)
    less = np.flatnonzero(worths[: found.rows.start] < found.worth / 2)
    high = (found.rows.stop - (less[-1] + 1 if len(less) else 0)) * found.away / plate.focal[1]
    ends = np.stack([shown_at(plate, edge, found.away) for edge in (columns.start - 0.5, columns.stop - 0.5)])
    cuts = columns.start < WINDOW, columns.stop > plate.grey.shape[1] - WINDOW
    eye, left = plate.eye()[:2], _left(plate)
    told = found.away, 0.0, speed, found.worth, found.grounded
    ahead = np.array([left[1], -left[0]])
    return _turned(Sighting(time_us, eye, ahead, *told, any(cuts), ends=eye + ends, cuts=cuts, high=float(high)), eye)
