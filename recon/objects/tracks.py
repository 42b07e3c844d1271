"""What the readers of boxes share: classes as slugs, names by nearness, and what counts as moving."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
import torch

from recon.log import Track
from recon.objects.curves import APART_US
from scenes.poses import inverse, pose_from
from scenes.trajectory import Trajectory

KINDS = {"pedestrian": "ped", "bicycle": "cyc", "motorcycle": "cyc", "scooter": "cyc", "cyclist": "cyc"}
LIMBED = frozenset({*KINDS, "personal-mobility-device", "wheeled-device", "stroller", "animal", "animals-other", "dog"})
"""Classes whose bodies bend as they go, by all readers' names."""

VEHICLES = {
    "car", "pickup", "truck", "bus", "van", "vehicle", "construction-vehicle", "emergency-vehicle", "trailer", "pedicab", "train", "tram",
}  # fmt: skip

MOVED = 1.0
"""Metres in plan that a box's middle goes before it counts as moving, where the log does not say: annotators' boxes wander by half of that,
and heights by more, as GPS does."""

RARE = 2.5
"""Times as long as the shortest between two of its boxes may be that between two others for something to be known between them, however
rarely a log annotates."""

MOMENT_US = 50_000
"""Before and after its only box, in which something that moves is taken to be there: in a sweep, and not in the next."""

FACES_US, LIMBED_US = 750_000, 150_000
"""Between two boxes at most, for something to face in the second about as in the first: nuScenes annotates every half second, in which
people do turn round."""


@dataclass(frozen=True)
class Boxes:
    """One object as a log annotates it: its identifier, class, times int64 us `[T]`, `world_from_box` `[T, 4, 4]` and sizes `[T, 3]`
    (length, width, height). The box frame has its origin at the base centre, x forward, z up."""

    source: str
    label: str
    times_us: np.ndarray
    world_from_box: torch.Tensor
    sizes: np.ndarray


def slug(label: str, known: dict[str, str]) -> str:
    """A class as a slug, by the log's own table first; unknown ones in lower case with dashes."""
    return known.get(label) or re.sub(r"[^a-z0-9]+", "-", label.lower()).strip("-") or "object"


def upright(places: np.ndarray, headings: np.ndarray) -> torch.Tensor:
    """Poses `[T, 4, 4]` at places `[T, 3]`, turned by headings `[T]` radians about z."""
    half = np.asarray(headings, dtype=np.float64) / 2
    return pose_from(np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], 1), places)


def from_middles(poses: torch.Tensor, heights: np.ndarray) -> torch.Tensor:
    """Boxes' poses `[T, 4, 4]` at their base centres, of such at their middles and heights `[T]`."""
    down = torch.eye(4, dtype=torch.float64).repeat(len(poses), 1, 1)
    down[:, 2, 3] = -torch.from_numpy(np.asarray(heights, dtype=np.float64)) / 2
    return poses @ down


def tracks_of(found: list[Boxes], ego: Trajectory, where: str) -> tuple[Track, ...]:
    """Tracks of annotated boxes, named. What goes less than `MOVED` stands, be a box astray or not. ValueError naming a box with an
    impossible size or place."""
    made = []
    for boxes in found:
        order = np.argsort(boxes.times_us, kind="stable")
        times, poses = boxes.times_us[order], boxes.world_from_box[torch.from_numpy(order)]
        size = np.median(boxes.sizes, axis=0)
        if not (np.isfinite(size).all() and (size > 0).all() and torch.isfinite(poses).all()):
            raise ValueError(f"{where}: box {boxes.source} must have positive sizes and finite places, got {size.tolist()} m")
        if not (np.diff(times) > 0).all():
            raise ValueError(f"{where}: box {boxes.source} stands twice at one time")
        middle = _steady(poses[:, :2, 3])
        moving = bool((middle - middle.median(0).values).norm(dim=1).max() > MOVED)
        made.append(Track("", boxes.label, moving, size, times, poses, np.full(len(times), -1), (boxes.source,)))
    return named(made, ego)


def _steady(places: torch.Tensor) -> torch.Tensor:
    """Places `[T, 2]` without those that are alone in being off: running medians of three, at an end with where the two beside it would
    take it (Tukey 1977)."""
    if len(places) < 3:
        return places
    out = places.clone()
    out[1:-1] = torch.stack([places[:-2], places[1:-1], places[2:]]).median(0).values
    for end, next_, after in ((0, 1, 2), (-1, -2, -3)):
        out[end] = torch.stack([places[end], out[next_], 3 * out[next_] - 2 * out[after]]).median(0).values
    return out


def named(tracks: list[Track], ego: Trajectory) -> tuple[Track, ...]:
    """The tracks as `veh_1`, `ped_1`, `cyc_1`, `obj_1`, ..., each kind numbered by how near it came to the body; none spins (`facing`), and
    none goes on where nobody knows of it (`known`)."""
    numbers: dict[str, int] = {}
    out = []
    parts = [part for track in tracks for part in known(facing(track))]
    for _, track in sorted(((nearness(t, ego), t) for t in parts), key=lambda pair: (pair[0], pair[1].sources)):
        kind = "veh" if track.label in VEHICLES else KINDS.get(track.label, "obj")
        numbers[kind] = numbers.get(kind, 0) + 1
        out.append(replace(track, name=f"{kind}_{numbers[kind]}"))
    return tuple(out)


def facing(track: Track) -> Track:
    """The track without turns on the spot: annotators, and networks more so, take a rear for a front now and then, and between two such
    boxes a car would spin. Boxes that follow one another soon face as most of them do."""
    ahead = track.world_from_box[:, :3, 0]
    turned = ((ahead[1:] * ahead[:-1]).sum(1) < 0).numpy()
    later = np.flatnonzero(np.diff(track.times_us) > (LIMBED_US if track.label in LIMBED else FACES_US)) + 1
    poses = track.world_from_box.clone()
    for run in np.split(np.arange(len(poses)), later):
        back = np.cumsum([False, *turned[run[:-1]]]) % 2 > 0
        wrong = torch.from_numpy(run[back if back.mean() <= 0.5 else ~back])
        poses[wrong] = poses[wrong] @ torch.diag(torch.tensor([-1.0, -1, 1, 1], dtype=torch.float64))
    return replace(track, world_from_box=poses)


def known(track: Track) -> list[Track]:
    """A track in those parts between which it is not known where what moves was: `APART_US` apart, or `RARE` steps where these are longer.
    Of one box alone what moves is there for a moment: a trajectory of one pose would stand there all the time."""
    if not track.moving:
        return [track]
    gaps = np.diff(track.times_us)
    longest = max(APART_US, RARE * gaps.min(initial=APART_US))
    return [_part(track, run) for run in np.split(np.arange(len(track.times_us)), np.flatnonzero(gaps > longest) + 1)]


def _part(track: Track, boxes: np.ndarray) -> Track:
    """A track of these of its boxes, and for a moment where it is but one."""
    times = track.times_us[boxes]
    if len(boxes) == 1:
        boxes, times = boxes.repeat(3), times + MOMENT_US * np.arange(-1, 2)
    return replace(track.part(boxes), times_us=times)


def nearness(track: Track, ego: Trajectory) -> float:
    """Metres between the body and the box where they were nearest; inf where they share no time."""
    times = torch.from_numpy(track.times_us)
    shared = ego.covers_each(times)
    away = (inverse(ego.at_each(times[shared])) @ track.world_from_box[shared])[:, :3, 3].norm(dim=1)
    return float(away.min()) if len(away) else float("inf")
