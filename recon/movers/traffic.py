"""Traffic that pictures alone show: what moves along the street, or crosses it, followed from picture to picture, as boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from recon.log import Log, Track
from recon.movers.crossed import believed as crossing_believed
from recon.movers.crossed import boxed as crossing_boxed
from recon.movers.crossing import crossings
from recon.movers.going import boxed
from recon.movers.sighting import Sighting, sightings
from recon.objects.tracks import named
from recon.seeds.stereo import Plate, plate_of
from recon.side_by_side import side_by_side
from recon.views.frames import Frames
from recon.views.view import View
from render.progress import Progress
from scenes.ground import Ground
from scenes.lane import Lane

GAPS_US = (200_000, 500_000)
"""Before and after a picture, about when others were taken that it is compared with: within the first a car that comes is still in view,
and must be there at all; by the second one that drives ahead has not become larger, though we drove on."""

SOON_US = 80_000
"""How soon after a picture the next is looked at, at most: a video's thirty a second would tell no more."""

NEARLY = 0.6
"""Part by which these may differ from that."""

STRIDE = 1.0
"""Metres between places of the body that tell where the street leads."""

GATE = (1.0, 0.2), (0.6, 0.03), 5.0
"""Metres, and parts of the distance, that a thing may be off where its speed takes it, along the street and across; and m/s that its speed
may be."""

FASTER_ACROSS = 2.5
"""Metres a second by which what crosses may seem to be faster or slower than it was."""

LOST_US = 500_000
"""How long after it was seen last a thing is given up."""

PACE = 8
"""Pictures over which its place and speed are taken."""

FEWEST, SHARE = 6, 0.6
"""Pictures that must show a thing for it to be believed, and the part of those taken meanwhile that must."""

CLEARLY = 0.12, 0.08
"""By how much it must look more alike than what stands still, and the ground before it than if it went on there, in half of them."""

ENOUGH = 0.5, 2.5
"""Seconds for which it must look more alike than what stands still, and the ground before it than if it went on there, times both together;
or metres that it has come meanwhile, times the same: what stands looks a little so for a moment, and what comes fast is soon gone."""

WENT = 3.0
"""Metres that it must go."""

KEPT, AT_LEAST = 0.5, 1.0
"""Part of the speed that pictures tell, and metres a second at least, by which its places may have it go otherwise: what does not go where
it seems to is something else."""

ASIDE = 0.55, 0.08
"""Metres a second, and parts of its speed, by which it may go to a side in the median, the more of both: what stands and is taken for
something that comes seems to come aslant."""

SAME = (1.3, 1.3), 0.4
"""Lengths and widths of a box within which another's middle belongs to the same thing, and the part of its time, or of that which both
have, in which that must be."""


def traffic(log: Log, frames: Frames, ground: Ground) -> tuple[Track, ...]:
    """What moves along the street, or crosses it, in the training pictures of the first camera of `frames`, as tracks at their moments.

    Nothing where pictures do not follow one another soon (`GAPS_US`), or the recording car never goes, and nobody knows where the street
    leads.
    """
    views = spaced(sorted(frames.of(0), key=lambda v: v.time_us))
    path = way_of(log.ego.world_from_body[:, :3, 3].numpy())
    if len(path) < 2 or len(views) < FEWEST:
        return ()
    times, plates = np.array([v.time_us for v in views]), [plate_of(v.image, frames.camera(log, v)) for v in views]
    eyes = np.array([p.eye()[:2] for p in plates])
    paces = np.linalg.norm(np.gradient(eyes, times / 1e6, axis=0), axis=1)

    def looked_at(i: int) -> tuple[list[Sighting], list[Sighting]]:
        told = plates[i], int(times[i]), around(i, plates, times), ground
        return sightings(*told, path, float(paces[i])), crossings(*told)

    seen: list[tuple[list[Sighting], list[Sighting]]] = []
    with Progress("traffic", total=len(views)) as steps:
        for found in side_by_side(looked_at, range(len(views))):
            seen.append(found)
            steps.step()
    going, across = ([found[kind] for found in seen] for kind in (0, 1))
    along_lane = boxes(going, times, plates, Lane(log.ego), ground)
    return named(apart([*along_lane, *crossed(across, times, plates, ground)]), log.ego)


def spaced(views: Sequence[View]) -> list[View]:
    """Those of views in time order that are `SOON_US` apart."""
    kept = list(views[:1])
    for view in views[1:]:
        if view.time_us - kept[-1].time_us >= SOON_US:
            kept.append(view)
    return kept


def way_of(places: np.ndarray) -> np.ndarray:
    """Those of places `[T, 3]` that are a `STRIDE` in plan from the last one each, `[N, 3]`."""
    way = [places[0]]
    for place in places[1:]:
        if np.linalg.norm(place[:2] - way[-1][:2]) > STRIDE:
            way.append(place)
    return np.array(way)


def boxes(seen: list[list[Sighting]], times: np.ndarray, plates: Sequence[Plate], lane: Lane, ground: Ground) -> list[Track]:
    """Tracks of what was `seen` going along a lane, at the `times` `[T]` of pictures, `plates`. What is clearest comes first, and is told
    more of by what else was followed of it."""
    made: list[tuple[list[Sighting], Track]] = []
    for thing in sorted((f for f in follow(seen) if believed(f, times)), key=lambda f: -sum(s.worth for s in f)):
        track = boxed(thing, times, plates, lane, ground)
        meets = [_beside(track, other) for _, other in made]
        same = next((k for k, met in enumerate(meets) if len(met) and met.mean() > SAME[1]), None)
        if same is None:
            made.append((thing, track))
            continue
        own = made[same][0]
        told = {s.time_us for s in own}
        whole = sorted([*own, *(s for s in thing if s.time_us not in told)], key=lambda s: s.time_us)
        made[same] = whole, boxed(whole, times, plates, lane, ground)
    return [track for _, track in made]


def crossed(seen: list[list[Sighting]], times: np.ndarray, plates: Sequence[Plate], ground: Ground) -> list[Track]:
    """The like of what was seen crossing; what is longest comes first, since wheels and doors are parts of cars."""
    made = [crossing_boxed(thing, times, plates, ground) for thing in follow(seen) if crossing_believed(thing, times)]
    return apart(sorted(made, key=lambda track: -track.size[0]))


def apart(tracks: Sequence[Track]) -> list[Track]:
    """Those of tracks that are no other, earlier one's."""
    made: list[Track] = []
    for track in tracks:
        if not any(_beside(track, other).sum() > SAME[1] * len(track.times_us) for other in made):
            made.append(track)
    return made


def around(i: int, plates: list[Plate], times: np.ndarray) -> list[list[tuple[Plate, int]]]:
    """The plates before one, and those after it, that it is compared with, and their times."""
    sides = []
    for later in (-1, 1):
        off = [np.abs(later * (times - times[i]) - gap) / gap for gap in GAPS_US]
        if off[0].min() < NEARLY:
            chosen = dict.fromkeys(int(o.argmin()) for o in off if o.min() < NEARLY)
            sides.append([(plates[j], int(times[j])) for j in chosen])
    return sides


def follow(seen: list[list[Sighting]]) -> list[list[Sighting]]:
    """Sightings of pictures in time order, by thing (assignment by least total distance, Kuhn 1955)."""
    things: list[list[Sighting]] = []
    for found in seen:
        live = [t for t in things if found and found[0].time_us - t[-1].time_us <= LOST_US]
        cost = np.array([[_apart(thing, s) for s in found] for thing in live]).reshape(len(live), len(found))
        pairs = [(i, j) for i, j in zip(*linear_sum_assignment(cost), strict=True) if cost[i, j] < 4]
        for i, j in pairs:
            live[i].append(found[j])
        taken = {j for _, j in pairs}
        things += [[s] for j, s in enumerate(found) if j not in taken]
    return things


def _apart(thing: list[Sighting], s: Sighting) -> float:
    """How far a sighting is from where a thing should be: the sum of what it is off in parts of what is allowed; 9 where that is more."""
    last = thing[-PACE:]
    velocity = np.mean([k.velocity for k in last], axis=0)
    place = np.mean([k.place + velocity * (s.time_us - k.time_us) / 1e6 for k in last], axis=0)
    off = s.place - place
    along, across = abs(off @ s.along), abs(off[1] * s.along[0] - off[0] * s.along[1])
    faster = [abs(s.speed - np.mean([k.speed for k in last])) / GATE[2]]
    if s.ends is not None:  # what crosses is known by how fast it does; drifts of what goes along are too vague
        faster.append(abs(s.axes[1] @ (s.velocity - velocity)) / FASTER_ACROSS)
    parts = [along / (GATE[0][0] + GATE[0][1] * s.away), across / (GATE[1][0] + GATE[1][1] * s.away), *faster]
    return float(sum(parts)) if max(parts) < 1 else 9.0


def believed(thing: list[Sighting], times: np.ndarray) -> bool:
    """Whether it is seen often enough, goes far enough, and goes where its speed takes it."""
    between = ((times >= thing[0].time_us) & (times <= thing[-1].time_us)).sum()
    if len(thing) < max(FEWEST, SHARE * between) or (np.median([(s.worth, s.grounded) for s in thing], axis=0) < CLEARLY).any():
        return False
    seconds = np.array([s.time_us for s in thing]) / 1e6
    seconds -= seconds.mean()
    steps = np.array([(s.place - thing[0].place) @ thing[0].along for s in thing])
    told, aside = np.median([(s.speed, s.aside) for s in thing], axis=0)
    clear = sum(s.worth + s.grounded for s in thing) * float(np.median(np.diff(times))) / 1e6
    if abs(aside) > max(ASIDE[0], ASIDE[1] * abs(told)) or (clear < ENOUGH[0] and -told * clear < ENOUGH[1]):
        return False
    went = float(np.polyfit(seconds, steps, 1)[0])
    return bool(abs(told) * np.ptp(seconds) > WENT and abs(went - told) < max(KEPT * abs(told), AT_LEAST))


def _beside(track: Track, other: Track) -> np.ndarray:
    """Whether a track's middle lies in or beside the other's box, bool `[T]`, at the times that both have."""
    _, mine, its = np.intersect1d(track.times_us, other.times_us, return_indices=True)
    back = torch.linalg.inv(other.world_from_box[its]).numpy()
    place = track.world_from_box[mine, :3, 3].numpy()
    local = np.einsum("nij,nj->ni", back[:, :2, :3], place) + back[:, :2, 3]
    return (np.abs(local) < other.size[:2] * SAME[0]).all(1)
