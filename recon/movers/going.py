"""The box of a car that pictures show going along the street: in its lane, also while a picture's border cuts it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from recon.log import Track
from recon.movers.boxing import CAR, smoothed
from recon.movers.sighting import Sighting
from recon.objects.actors import CORNERS
from recon.objects.tracks import upright
from recon.seeds.stereo import Plate
from scenes.ground import Ground
from scenes.lane import Lane

OFF, CUT = (0.08, 0.012), (0.25, 0.25)
"""Parts of their distance by which places are off, along the line of sight and across; and where a border cuts what is seen, which may be
anything of it."""

PACES = 2.5, 0.5
"""Metres a second by which speeds are off, along the street and across."""

KEEPS = 6.0
"""How much less it is pushed across the street than along it."""

BEYOND_US = 700_000
"""How long before its first picture and after its last one it goes on, far away."""

LONGEST_US = 3_000_000
"""How long at most, where it is beside us or a border cuts it."""

TOLD = 0.12
"""Metres by which a fit takes places to be off that pictures alone tell. They are off by several times that along the line of sight, where
nothing shows it but a car that does not look the same in all pictures; twice as far cars looked more alike, but lost their shape."""

HIGH = 1.55
"""Metres up of a car, whose sizes all are taken to have: before a street that is far away nobody sees where its roof ends."""


def boxed(thing: Sequence[Sighting], times: np.ndarray, plates: Sequence[Plate], lane: Lane, ground: Ground) -> Track:
    """The box of a thing, a car's, at those of the `times` `[T]` of pictures, `plates`, at which it is there: it keeps its place across the
    lane and its speed before it is seen first and after it is seen last."""
    own = np.array([s.time_us for s in thing])
    near = np.flatnonzero((times >= own[0] - LONGEST_US) & (times <= own[-1] + LONGEST_US))
    stamps, plates = times[near], [plates[int(i)] for i in near]
    first, last = np.searchsorted(stamps, own[[0, -1]])
    eyes = np.array([plates[int(i)].eye()[:2] for i in np.searchsorted(stamps, own)])
    face = _in_lane(thing, eyes, stamps, lane)
    left = face[np.clip(np.arange(len(stamps)), first, last), 1]
    # what is seen of it is the end that looks at us; it may go past us after that
    beyond = np.sign(np.median([s.along @ (s.place - eye) for s, eye in zip(thing, eyes, strict=True)]))
    points, headings = lane.at(torch.from_numpy(face[:, 0] + beyond * CAR[0] / 2), 0.0)
    ways = headings.numpy()
    middle = points.numpy() + left[:, None] * np.stack([-np.sin(ways), np.cos(ways)], 1)
    base = np.column_stack([middle, ground.height(torch.from_numpy(middle)).numpy()])
    poses = upright(base, np.unwrap(ways) + np.pi * (np.median([s.speed for s in thing]) < 0))
    size = np.array([*CAR, HIGH])
    return while_there("car", size, stamps, poses, plates, own)


def while_there(label: str, size: np.ndarray, stamps: np.ndarray, poses: torch.Tensor, plates: Sequence[Plate], own: np.ndarray) -> Track:
    """The track of a box of a size, whose poses `[T, 4, 4]` at stamps `[T]`, those of `plates`, are known, in that part of its time in
    which it is there: when it was seen, `own` `[S]`, for a moment more, and while a border cuts it or it is beside us."""
    first, last = np.searchsorted(stamps, own[[0, -1]])
    there = np.abs(stamps - np.clip(stamps, *own[[0, -1]])) <= BEYOND_US
    there |= np.array([_leaves(pose, size, plate) for pose, plate in zip(poses.numpy(), plates, strict=True)])
    gone = np.flatnonzero(~there)
    kept = slice(gone[gone < first].max(initial=-1) + 1, gone[gone > last].min(initial=len(stamps)))
    where = f"seen at {poses[kept][0, :3, 3].numpy().round(1).tolist()}"
    return Track("", label, True, size, stamps[kept], poses[kept], np.full(len(stamps[kept]), -1), (where,), TOLD)


def _in_lane(thing: Sequence[Sighting], eyes: np.ndarray, stamps: np.ndarray, lane: Lane) -> np.ndarray:
    """Where what is seen of a thing from `eyes` `[S, 2]` is at times `[T]`, smoothed: metres `[T, 2]` along the lane and to its left."""
    along = np.stack([s.along for s in thing])
    sight = np.stack([s.place for s in thing]) - eyes
    turned = np.stack([(sight * along).sum(1), along[:, 0] * sight[:, 1] - along[:, 1] * sight[:, 0]], 1)
    away = np.linalg.norm(turned, axis=1)
    axes = np.stack([turned, turned[:, ::-1] * [-1, 1]], 1) / away[:, None, None]
    off = away[:, None] * np.where([[s.cut] for s in thing], CUT, OFF)
    told = np.einsum("tki,tkj,tk->tij", axes, axes, 1 / off**2)
    places = np.array([lane.of(torch.from_numpy(s.place)) for s in thing])
    # what is pushed less across is smoothed as if it were so much wider
    wider = np.array([1.0, KEEPS])
    paces = wider * [[s.speed, s.aside] for s in thing], wider * PACES
    seconds = np.array([s.time_us for s in thing]) / 1e6
    return smoothed(seconds, places * wider, stamps / 1e6, told / np.outer(wider, wider), paces) / wider


def _leaves(pose: np.ndarray, size: np.ndarray, plate: Plate) -> bool:
    """Whether a box `[4, 4]` of a size is cut by the picture's border, or beside the camera."""
    *_, z, inside = plate.shown(CORNERS * size @ pose[:3, :3].T + pose[:3, 3])
    return bool(z.max() > 0 and not inside.all())
