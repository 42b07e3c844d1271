"""What moves along the street, as a picture tells it together with some from before and after: cars ahead, oncoming and overtaking ones.

A thing that goes along with the camera looks like a standing one elsewhere: farther away and larger where it goes our way, nearer and
smaller where it comes. But it stands on the ground, and what it hides of that tells where. So each place on the ground is asked whether
what stands there looks alike in all pictures if it moves, and more so than anything that stands still could; and whether the ground before
it is seen (a plane sweep, Collins 1996, over places and speeds).

From aside a car shows its end that looks at us and a flank. Its place is the one at which both together have the outline that is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage

from recon.movers.boxing import CAR
from recon.seeds.dense import FARTHEST, ground_depth
from recon.seeds.stereo import WINDOW, Plate, box_means
from recon.seeds.ways import at_rest, unlike
from scenes.ground import Ground

DISTANCES = 4.5 * 1.09 ** np.arange(27)
"""Metres ahead at which things are looked for, up to 42; what seems to be at the last may be farther."""

ONCOMING, PASSING = 20, 12
"""Metres a second at which things come towards us at most, and by which they go faster than we do."""

DRIFTS = np.arange(-4, 4.1, 1.0), np.arange(-1.5, 1.6, 0.25)
"""Metres a second by which a thing may go faster than what suits the street's direction best, and leftwards: the other lane may lead three
degrees elsewhere, and far aside a drift of half a metre a second looks like more than one less along the street."""

SLOWEST = 1.5
"""Metres a second from which on something is believed to move."""

REAR = 1.7, 1.3
"""Metres across and up that are looked at together: a car's rear but for its roof, through whose windows the street is seen."""

BEFORE = 0.7
"""Metres of the ground before it that must be seen, as high as it would be if it stood there."""

STANDING = 40, (4.0, 120.0)
"""Depths, in equal steps of their inverse, at which what stands still may be."""

ALONG, FARTHEST_ALONG = (-8.0, -4.0, 4.0, 8.0), 8.0
"""Pixels aside to where the street's direction takes a thing in its own picture, which a rail or a wall looks like there, and metres up to
which that is asked for: what is straight ahead goes nowhere."""

UNDER, NEARER = 0.87, 1.12
"""Parts of its inverse depth by which what stands still may be under the ground, and nearer than the place that is asked about."""

WORTH, GROUNDED = 0.07, 0.04
"""By how much a thing must look more alike than what stands still, and the ground before it than if the thing went on there."""

LIKE = 1.5
"""Times as wide, or as narrow, as a car that what is taken for one may look."""

HIDDEN, HIDING = 0.07, 1.3
"""By how much something that stands nearer, by this part of inverse depth at least, may look more alike than the ground before a thing:
what hides that hides its foot, and a tree behind a parked car seems to come."""

LEVEL = 0.3
"""Cosine between down a picture and down, at least."""

CLIMB = 3
"""Places of a path to either side of one, by which it is told how steep it is there."""

APART = 0.6
"""Of a rear's width: two things in a picture are that far apart at least."""

CLEAR, ALIKE, ONE = 0.5, 5.0, 1.3
"""Two sightings are of one car where the nearer one looks at least so many times as much more alike as the other, their speeds differ by so
many m/s at most, and they are so many of its lengths and widths apart."""


@dataclass(frozen=True)
class Sighting:
    """Something that moves, in a picture at `time_us`: where the middle of its end that looks at us stands `[2]`, the street's direction
    there `[2]`, how far ahead of the camera what is seen of it is, and its speeds along the street and to its left in m/s, `speed` and
    `aside`; by how much it looks more alike than what stands still, `worth`, and the ground before it than if it went on there, `grounded`.
    cut: whether the picture's border is so near that there may be more of it beyond; rise: metres that the street climbs with every one of
    it.

    Of what crosses (`crossing.py`) the place is that of all that is seen of it, and the street's direction stands for that of the line of
    sight; ends: where its left and right ends stand, `[2, 2]`; cuts: whether a border cuts the left one, and the right one;
    high: metres up that it reaches."""

    time_us: int
    place: np.ndarray
    along: np.ndarray
    away: float
    speed: float
    aside: float
    worth: float
    grounded: float
    cut: bool
    rise: float = 0.0
    ends: np.ndarray | None = None
    cuts: tuple[bool, bool] = (False, False)
    high: float = 0.0

    @property
    def axes(self) -> np.ndarray:
        """The directions `[2, 2]` of the street and to its left."""
        return np.array([self.along, [-self.along[1], self.along[0]]])

    @property
    def width(self) -> float:
        """Metres from its left end to its right one; 0 where nobody knows of ends."""
        return 0.0 if self.ends is None else float(np.linalg.norm(self.ends[0] - self.ends[1]))

    @property
    def velocity(self) -> np.ndarray:
        """Metres a second `[2]` in the world."""
        return np.array([self.speed, self.aside]) @ self.axes


@dataclass(frozen=True)
class _Found:
    """A sighting, `one`, of what so many columns `across` show around x, in `rows`; how good it is, `score`; and by how much each of all
    columns looks more alike than what stands still, `worths` `[w]`, which costs `stands` `[rows, w]`."""

    score: float
    one: Sighting
    x: int
    across: int
    rows: slice
    worths: np.ndarray
    stands: np.ndarray

    @property
    def shown(self) -> slice:
        """The columns that show it."""
        return slice(max(0, self.x - self.across // 2), self.x + self.across // 2 + 1)


def sightings(
    plate: Plate, time_us: int, sides: Sequence[Sequence[tuple[Plate, int]]], ground: Ground, path: np.ndarray, pace: float
) -> list[Sighting]:
    """What moves in a plate taken at a time, best first. sides: plates of its size before it, and after it, with their times; path:
    places `[N, 3]` of the body, in order, each some way from the last; pace: its speed then."""
    if not sides:
        return []
    eye, speeds = plate.eye(), np.arange(-ONCOMING, pace + PASSING, 1.0)
    deepest = np.minimum(ground_depth(plate, ground, 0.0), FARTHEST)
    inverse_depths = torch.linspace(1 / STANDING[1][1], 1 / STANDING[1][0], STANDING[0])
    standing = box_means(unlike(plate, at_rest(sides, STANDING[0]), slice(None), 1 / inverse_depths.double().numpy()))
    of_ground = box_means(unlike(plate, at_rest(sides), slice(None), torch.from_numpy(deepest).float()))[0].numpy()
    found = []
    for z in DISTANCES:
        base = base_row(plate, ground, z)
        rows = slice(max(0, round(base - REAR[1] * plate.focal[1] / z)), round(base + BEFORE * plate.focal[1] / z) + 1 + WINDOW // 2)
        bottom = round(base) - rows.start
        before = slice(bottom + WINDOW // 2, None)
        if bottom < WINDOW or len(of_ground[rows][before]) < 2:
            continue
        along, rise = _along(path, eye[:2] + z * plate.axis()[:2])
        ways = [[(other, np.outer(speeds * (t - time_us) / 1e6, [*along, rise])) for other, t in side] for side in sides]
        moving = unlike(plate, ways, rows, float(z)).numpy()
        allowed = (inverse_depths[:, None, None] <= NEARER / z) & (inverse_depths[:, None, None] >= UNDER / torch.from_numpy(deepest[rows]))
        stands = np.minimum(torch.where(allowed, standing[:, rows], torch.inf).amin(0).numpy(), of_ground[rows])
        across = max(1, round(REAR[0] * plate.focal[0] / z))
        rims = slice(bottom + WINDOW // 2)  # squares around pixels under a thing show its rim, which a bare street does not outdo
        worths = stands[rims].mean(0) - moving[:, rims].mean(1)
        best, column = beside(worths, across).argmax(0), np.arange(len(stands[0]))
        worth = beside(worths, across)[best, column]
        grounded = beside((moving[:, before] - of_ground[rows][before]).mean(1), across)[best, column]
        hidden = beside(of_ground[rows][before].mean(0), across) - hiding(standing[:, rows][:, before], inverse_depths * z, across)
        fits = (worth > WORTH) & (grounded > GROUNDED) & (hidden < HIDDEN) & (np.abs(speeds[best]) >= SLOWEST)
        for x in np.flatnonzero(fits):
            cut = not across < x < len(stands[0]) - across
            told = float(z), float(speeds[best[x]]), 0.0, float(worth[x]), float(grounded[x])
            one = Sighting(time_us, eye[:2], along, *told, cut, rise)  # its outline tells where it is
            score = float(worth[x] + min(grounded[x], worth[x]))
            part = slice(rows.start, rows.start + bottom)
            found.append(_Found(score, one, int(x), across, part, worths[best[x]], stands[:bottom]))
    kept: list[_Found] = []
    for new in sorted(found, key=lambda f: -f.score):
        if all(abs(new.x - old.x) > APART * max(new.across, old.across) for old in kept):
            kept.append(new)
    kept = [_no_rail(plate, new) for new in kept if new.one.away < DISTANCES[-1]]
    return nearest_of_each([_refined(plate, sides, new) for new in kept if new.one.worth > WORTH])


def nearest_of_each(seen: Sequence[Sighting]) -> list[Sighting]:
    """Of sightings of one picture those that are no other's flank: what is behind the end that looks at us, within a car's length of it, is
    of the same car, whose flank seems to be another one that goes as fast."""
    ends: list[Sighting] = []
    for one in sorted(seen, key=lambda s: (s.away, -s.worth)):
        if not any(_flank(one, end) for end in ends):
            ends.append(one)
    return sorted(ends, key=lambda s: -s.worth)


def _flank(one: Sighting, end: Sighting) -> bool:
    """Whether a sighting is of the car whose end another one, no farther off, is."""
    if end.worth < CLEAR * one.worth or abs(one.speed - end.speed) > ALIKE:
        return False
    return bool((np.abs(end.axes @ (one.place - end.place)) < ONE * np.array(CAR)).all())


def _no_rail(plate: Plate, found: _Found) -> _Found:
    """What was found, by how much it looks more alike than what stands still, or than it looks like itself some way along the street: rails
    and walls look alike all along, and seem to go as fast as we do."""
    columns = slice(max(0, found.shown.start - WINDOW), found.shown.stop + WINDOW)
    stands = found.stands[:, columns]
    itself = along_itself(plate, found.one, found.x, found.rows, columns)
    less = beside((stands - np.minimum(stands, itself)).mean(0), found.across)[found.x - columns.start]
    return replace(found, one=replace(found.one, worth=found.one.worth - float(less)))


def along_itself(plate: Plate, one: Sighting, x: int, rows: slice, columns: slice) -> np.ndarray:
    """How unlike a plate is to itself where the street's direction leads from what columns around x show in rows as far away as a sighting,
    `[rows, columns]`; infinite for what is straight ahead, which that leads nowhere."""
    metres = np.array(ALONG) * one.away / max(abs(x + 0.5 - plate.centre[0]), 1e-3)
    metres = metres[np.abs(metres) <= FARTHEST_ALONG]
    part, ways = plate.columns(columns), np.outer(metres, [*one.along, one.rise])
    if not len(metres):
        return np.full(part.grey[rows].shape, np.inf)
    return unlike(part, [[(plate, ways)]], rows, one.away).mean(0).numpy()


def _refined(plate: Plate, sides: Sequence[Sequence[tuple[Plate, int]]], found: _Found) -> Sighting:
    """A sighting at the place that its outline tells, with its speeds along the street and across it."""
    one, shown = found.one, found.shown
    seen = [one.axes @ shown_at(plate, x, one.away) for x in (found.x, *outline(found.worths, shown))]
    part = plate.columns(shown)
    speeds = np.stack(np.meshgrid(one.speed + DRIFTS[0], DRIFTS[1]), -1).reshape(-1, 2)
    each = np.column_stack([speeds @ one.axes, one.rise * speeds[:, 0]])
    ways = [[(other, each * (t - one.time_us) / 1e6) for other, t in side] for side in sides]
    speed, aside = speeds[int(unlike(part, ways, found.rows, one.away).mean((1, 2)).argmin())]
    return replace(one, place=plate.eye()[:2] + facing_us(*seen) @ one.axes, speed=float(speed), aside=float(aside))


def outline(worths: np.ndarray, shown: slice) -> tuple[int, int]:
    """The first and last column of a thing that some columns show: by how much all look more alike, `worths` `[w]`, is there at least half
    of what it is in these."""
    smooth = beside(worths, WINDOW)
    less = np.flatnonzero(smooth < worths[shown].mean() / 2)
    k = int(np.searchsorted(less, shown.start + int(smooth[shown].argmax())))
    return (int(less[k - 1]) + 1 if k else 0), (int(less[k]) - 1 if k < len(less) else len(worths) - 1)


def facing_us(seen: np.ndarray, *ends: np.ndarray) -> np.ndarray:
    """Where the middle of that end of a car is that looks at us, `[2]` along the street and to its left of us: some of the car is seen
    standing at a place, and the ends of its outline, those of its end and its flank together, in the directions of two more, each `[2]` so.
    The place itself where that outline is as wide as no car's."""
    if min(seen[0], *(end[0] for end in ends)) <= 0:
        return seen
    side = float(np.sign(ends[0][1] + ends[1][1])) or 1.0
    inner, outer = sorted(float(side * end[1] / end[0]) for end in ends)
    here, ahead, wide = float(side * seen[1] / seen[0]), float(seen[0]), CAR[1] / 2
    for _ in range(5):
        part, middle = ahead / (ahead + CAR[0]), (outer + inner) / 2 * ahead
        left = max(middle, (2 * middle - (1 - part) * wide) / (1 + part))
        # what is seen stands farther ahead than the end does where it is some of the flank
        stands = max(ahead, (left - wide) / here) if here > 0 else ahead
        ahead += float(seen[0]) - min(stands, ahead + CAR[0])
    usual = left + wide - (left - wide) * (part if left > wide else 1.0)
    return np.array([ahead, side * left]) if 1 / LIKE < (outer - inner) * ahead / usual < LIKE else seen


def shown_at(plate: Plate, column: float, away: float) -> np.ndarray:
    """What a column shows so far ahead, `[2]` in plan from the camera."""
    ray = np.array([(column + 0.5 - plate.centre[0]) / plate.focal[0], 0.0, 1.0]) @ plate.cam_from_world[:3, :3]
    return away * ray[:2]


def base_row(plate: Plate, ground: Ground, z: float) -> float:
    """The row at which what is z ahead stands, in the median over the columns."""
    x = (np.arange(0, plate.grey.shape[1], 8) + 0.5 - plate.centre[0]) / plate.focal[0]
    turn, y = plate.cam_from_world[:3, :3], np.zeros_like(x)
    for _ in range(3):  # down the picture, which on a hill is not down
        at = plate.eye() + z * np.stack([x, y, np.ones_like(x)], 1) @ turn
        above = at[:, 2] - ground.height(torch.from_numpy(at[:, :2].copy())).numpy()
        y += above / (z * max(-turn[1, 2], LEVEL))
    return float(np.median(y * plate.focal[1] + plate.centre[1]))


def hiding(standing: torch.Tensor, nearer: torch.Tensor, across: int) -> np.ndarray:
    """What it costs to take what windows around columns show for something that stands before a thing, `[w]`: the least of the costs
    `standing` `[D, rows, w]` of depths that are `HIDING` times `nearer` `[D]` than that."""
    costs = standing[nearer > HIDING].mean(1).numpy()
    return beside(costs, across).min(0, initial=np.inf)


def _along(path: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, float]:
    """The unit direction `[2]` in plan of a path `[N, 3]` where it is nearest to a place `[2]`, and metres that it climbs with every one:
    what drives there climbs, too, by half a metre from picture to picture on a steep street."""
    nearest = int(np.linalg.norm(path[:, :2] - place, axis=1).argmin())

    def way(reach: int) -> np.ndarray:
        return path[min(nearest + reach, len(path) - 1)] - path[max(nearest - reach, 0)]

    ahead, steep = way(1)[:2], way(CLIMB)
    return ahead / np.linalg.norm(ahead), float(steep[2] / np.linalg.norm(steep[:2]))


def beside(costs: np.ndarray, across: int) -> np.ndarray:
    """Means of `[..., w]` over so many columns."""
    return ndimage.uniform_filter1d(costs, across | 1, axis=-1, mode="nearest")
