"""The box of what crosses: how long it is, where it goes, and what it is, by what several pictures show of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from recon.log import Track
from recon.movers.boxing import CAR, headings, label, smoothed
from recon.movers.going import CUT, OFF, while_there
from recon.movers.sighting import Sighting
from recon.objects.tracks import upright
from recon.seeds.stereo import Plate
from scenes.ground import Ground

WENT, FEWEST, SHARE = 1.5, 6, 0.5
"""Metres that it must go, pictures that must show it, and the part of those taken meanwhile that must."""

CLEARLY = 0.25, 0.15
"""By how much it must look more alike than what stands still, and the ground before it than if it went on there, in half of them."""

KEPT, AT_LEAST = 0.35, 0.5
"""Part of the speed that pictures tell, and metres a second at least, by which its places may have it go otherwise."""

TOWARDS, SIDEWAYS = 3.0, 0.02
"""Metres a second by which speeds are off, along the line of sight, of which nothing is seen, and across it, there for each metre that it
is away: a quarter of a pixel from picture to picture."""

MIDDLE = 0.15
"""Metres by which the middle of what is seen is off the middle of the thing: arms swing, and doors are plain."""

SEEN = 0.9, 0.75
"""Quantiles of what was seen of a width, and of a height, over time that are taken for it: parts that are plain do not look more alike
anywhere."""

STEADY = np.array([6.0, 2.0])
"""How much less it is pushed along the line of sight, and across it, than cars along the street: it crosses once, and goes straight."""

LOW, HIGH = 1.4, 3.5
"""Metres up of a vehicle, at least and at most."""

PERSON, CYCLIST = (0.9, 0.7, 1.75), (1.8, 0.7, 1.75)
"""Length, width and height of who is narrow, and of who is less narrow."""

NARROW, MIDDLING, LONG = 1.1, 2.4, 12.0
"""Metres across up to which somebody walks, and up to which rides; and of anything."""

LONGEST_US = 1_500_000
"""How long before its first picture and after its last one it goes on, where a border cuts it or it is outside the picture."""

CHORD = 2.0
"""Metres before and after on its way between which it faces."""


def believed(thing: Sequence[Sighting], times: np.ndarray) -> bool:
    """Whether it is seen often enough, goes far enough, and goes where its speed takes it. times: of all pictures that were looked at."""
    between = ((times >= thing[0].time_us) & (times <= thing[-1].time_us)).sum()
    if len(thing) < max(FEWEST, SHARE * between) or (np.median([(s.worth, s.grounded) for s in thing], axis=0) < CLEARLY).any():
        return False
    left = thing[len(thing) // 2].axes[1]
    seconds = np.array([s.time_us for s in thing]) / 1e6
    seconds -= seconds.mean()
    told = float(np.median([s.velocity @ left for s in thing]))
    went = float(np.polyfit(seconds, [s.place @ left for s in thing], 1)[0])
    return bool(abs(told) * np.ptp(seconds) > WENT and abs(went - told) < max(KEPT * abs(told), AT_LEAST))


def boxed(thing: Sequence[Sighting], times: np.ndarray, plates: Sequence[Plate], ground: Ground) -> Track:
    """The box of a thing at those of the `times` `[T]` of pictures, `plates`, at which it is there."""
    own = np.array([s.time_us for s in thing])
    near = np.flatnonzero((times >= own[0] - LONGEST_US) & (times <= own[-1] + LONGEST_US))
    stamps, plates = times[near], [plates[int(i)] for i in near]
    thing = [_as_far(s, place) for s, place in zip(thing, _smooth(thing, np.stack([s.place for s in thing]), own), strict=True)]
    widths = np.array([s.width for s in thing])
    whole = ~np.array([s.cut for s in thing])
    wide = min(LONG, float(np.quantile(widths[whole], SEEN[0]) if whole.any() else widths.max()))
    sideways = np.median([s.velocity for s in thing], axis=0)
    sight = thing[len(thing) // 2].along
    high = float(np.clip(np.quantile([s.high for s in thing], SEEN[1]), LOW, HIGH))
    size = _size(wide, high, sideways / max(np.linalg.norm(sideways), 1e-9), sight)
    # what is seen of it is its near side
    faces = np.stack([_face(s, wide) for s in thing])
    path = _smooth(thing, faces, stamps)
    for _ in range(2):
        turned = np.unwrap(headings(path, CHORD))
        at = np.interp(own, stamps, turned)
        ahead = np.stack([np.cos(at), np.sin(at)], 1)
        away = np.stack([s.along for s in thing])
        deep = (np.abs((ahead * away).sum(1)) * size[0] + np.abs(ahead[:, 0] * away[:, 1] - ahead[:, 1] * away[:, 0]) * size[1]) / 2
        path = _smooth(thing, faces + deep[:, None] * away, stamps)
    base = np.column_stack([path, ground.height(torch.from_numpy(path)).numpy()])
    return while_there(label(size), size, stamps, upright(base, np.unwrap(headings(path, CHORD))), plates, own)


def _size(wide: float, high: float, ahead: np.ndarray, sight: np.ndarray) -> np.ndarray:
    """Length, width and height of what goes ahead, seen so wide and, if it is a vehicle, so high along a line of sight."""
    if wide < MIDDLING:
        return np.array(PERSON if wide < NARROW else CYCLIST)
    along = abs(float(ahead @ sight))
    across = float(np.sqrt(max(1 - along**2, 0.0)))
    return np.array([max(CAR[0] * 0.8, (wide - along * CAR[1]) / max(across, 0.3)), CAR[1], high])


def _face(one: Sighting, wide: float) -> np.ndarray:
    """Where the middle `[2]` of what is seen so wide would be, also where a border cuts one end of it off."""
    assert one.ends is not None
    if one.cuts == (True, False) or one.cuts == (False, True):
        left = one.axes[1]
        return one.ends[1] + wide / 2 * left if one.cuts[0] else one.ends[0] - wide / 2 * left
    return one.place


def _as_far(one: Sighting, place: np.ndarray) -> Sighting:
    """A sighting if what it shows is as far away as a place: as much larger as it is farther, and as fast, since what is seen is how far it
    goes in the picture."""
    assert one.ends is not None
    eye = one.place - one.away * one.along
    farther = float(np.clip((place - eye) @ one.along / one.away, 0.5, 2.0))
    told = {name: farther * getattr(one, name) for name in ("away", "speed", "aside", "high")}
    return replace(one, place=eye + farther * (one.place - eye), ends=eye + farther * (one.ends - eye), **told)


def _smooth(thing: Sequence[Sighting], places: np.ndarray, stamps: np.ndarray) -> np.ndarray:
    """Where it is at stamps `[T, 2]`, of places `[S, 2]` where it was seen."""
    frame = thing[len(thing) // 2].axes
    away = np.array([s.away for s in thing])
    off = np.hypot(away[:, None] * np.where([[s.cut] for s in thing], CUT, OFF), [0.0, MIDDLE])
    axes = np.stack([s.axes for s in thing]) @ frame.T
    told = np.einsum("tki,tkj,tk->tij", axes, axes, 1 / off**2)
    seconds = np.array([s.time_us for s in thing]) / 1e6
    paces = STEADY * (np.stack([s.velocity for s in thing]) @ frame.T), STEADY * [TOWARDS, SIDEWAYS * np.median(away)]
    # what is pushed less is smoothed as if it were so much wider
    return smoothed(seconds, STEADY * (places @ frame.T), stamps / 1e6, told / np.outer(STEADY, STEADY), paces) / STEADY @ frame
