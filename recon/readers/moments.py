"""When the pictures of a COLMAP model were taken, which has no clock: by a file beside it, its rigs' frames, or the pictures' names."""

from __future__ import annotations

import json
from collections.abc import Hashable
from decimal import Decimal
from pathlib import Path, PurePosixPath

import numpy as np

from recon.readers.colmap_model import Model
from recon.readers.order import NUMBER

STEP_US = 500_000
"""From one picture to the next, where nobody says."""

MADE_UP = f"made up, {STEP_US / 1e6:g} s from one picture to the next; a times.json beside the model would tell it"
"""The clock then, in words."""

FASTEST_US = 100
"""Microseconds between a picture and the next, below which a clock counts seconds or milliseconds."""

SINCE, UNTIL, DAY_S = 900_000_000, 4_100_000_000, 86_400
"""Seconds since 1970 of the years 1998 and 2099, and of a day: what is in between is a time."""

Name = tuple[Decimal | str, ...]


def moments_of(where: Path, model: Model, lead: int) -> tuple[list[int], str]:
    """Microseconds of every picture of the model in the folder `where`, and who says so: its times.json, or their names, where these are
    times since 1970 (in seconds, or thousandths, millionths or billionths), else half a second apart in the order of the numbers in their
    names, by nobody.

    Those of one frame of a rig share a moment, as do those of several cameras whose names differ in what all of one camera's have alone
    (front_001.png, 001/left.png). Where what differs else is one number, and cameras do not share them, pictures of other cameras were
    taken as far between those of `lead` as the numbers are. ValueError where a camera takes two pictures at one moment.
    """
    clock = where / "times.json"
    if clock.is_file():
        moments, told, fix = _by_clock(clock, model), clock.name, f"give them different times in {clock}"
    else:
        (moments, told), fix = _by_name(model, lead), f"give microseconds by picture name in {clock}"
    taken: dict[tuple[int, int], str] = {}
    for image, moment in zip(model.images, moments, strict=True):
        other = taken.setdefault((image.camera, moment), image.name)
        if other != image.name:
            raise ValueError(f"{where} has one camera take {other} and {image.name} at one moment; {fix}")
    return moments, told


def _by_clock(clock: Path, model: Model) -> list[int]:
    try:
        times = json.loads(clock.read_text())
        told = [times[i.name] for i in model.images]
        moments = [int(t) for t in told]
    except (json.JSONDecodeError, UnicodeDecodeError, TypeError, KeyError, ValueError) as problem:
        raise ValueError(f"{clock} must give whole microseconds by picture name ({problem!r})") from None
    rising = np.unique(moments)
    if moments != told or len(rising) > 1 and np.median(np.diff(rising)) < FASTEST_US:
        raise ValueError(f"{clock} must give whole microseconds by picture name; it has {told[0]!r} for {model.images[0].name}")
    return moments


def _by_name(model: Model, lead: int) -> tuple[list[int], str]:
    names = _without_cameras(model)
    numbers = [name[0] for name in names if len(name) == 1 and isinstance(name[0], Decimal)]
    told = not model.rigid and len(numbers) == len(names)
    if told and (unit := _unit(numbers)) is not None:
        return [round((number - min(numbers)) * unit) for number in numbers], "times in the pictures' names"
    others = [name for name, i in zip(names, model.images, strict=True) if i.camera != lead]
    leading = {name for name, i in zip(names, model.images, strict=True) if i.camera == lead}
    if told and others and 2 * sum(name in leading for name in others) < len(others):
        return _between(numbers, sorted(name[0] for name in leading if isinstance(name[0], Decimal))), MADE_UP
    keys: list[Hashable] = [i.frame for i in model.images] if model.rigid else list(names)
    first: dict[Hashable, Name] = {}
    for key, name in zip(keys, names, strict=True):
        first.setdefault(key, name)
    order = {key: i for i, key in enumerate(sorted(first, key=lambda k: _sorting(first[k])))}
    return [order[key] * STEP_US for key in keys], MADE_UP


def _without_cameras(model: Model) -> list[Name]:
    """The pictures' names without suffix, as their texts and numbers, but for those that all pictures of a camera share."""
    split = [_split(i.name) for i in model.images]
    out: list[Name] = list(split)
    for camera in {i.camera for i in model.images}:
        mine = [k for k, i in enumerate(model.images) if i.camera == camera]
        if len({len(split[k]) for k in mine}) == 1:
            varies = [len(set(tokens)) > 1 for tokens in zip(*(split[k] for k in mine), strict=True)]
            for k in mine:
                out[k] = tuple(token for token, v in zip(split[k], varies, strict=True) if v)
    return out


def _split(name: str) -> Name:
    parts = [NUMBER.split(part) for part in PurePosixPath(name).with_suffix("").parts]
    return tuple(Decimal(token) if i % 2 else token for part in parts for i, token in enumerate(part) if token)


def _unit(numbers: list[Decimal]) -> Decimal | None:
    """Microseconds in one of the numbers, where all are times since 1970 on one day; None where they are no times."""
    for unit in (Decimal(10) ** power for power in (6, 3, 0, -3)):
        first, last = min(numbers) * unit / 10**6, max(numbers) * unit / 10**6
        if first > SINCE and last < UNTIL and last - first < DAY_S:
            return unit
    return None


def _sorting(name: Name) -> list[tuple[bool, Decimal, str]]:
    return [(False, token, "") if isinstance(token, Decimal) else (True, Decimal(0), token) for token in name]


def _between(numbers: list[Decimal], leading: list[Decimal]) -> list[int]:
    """Moments of pictures by their numbers, a step from each of the leading camera's to its next."""
    at = np.array([float(n - leading[0]) for n in leading])
    asked = np.array([float(n - leading[0]) for n in numbers])
    if len(at) < 2:
        return [STEP_US * int(n != 0) for n in asked]
    step = np.searchsorted(at, asked, side="right").clip(1, len(at) - 1)
    share = (asked - at[step - 1]) / (at[step] - at[step - 1])
    return np.round((step - 1 + share) * STEP_US).astype(np.int64).tolist()
