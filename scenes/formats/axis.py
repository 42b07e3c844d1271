"""Which axes a file's splats stand along, as far as it or its format says."""

from __future__ import annotations

import re
from pathlib import Path

from scenes.formats import COMPRESSED_PLY, GLB, PLY, SPZ, USD, found
from scenes.formats.ply import last_comment

_COMMENT = re.compile(rb"^comment[ \t]+vertical axis:[ \t]*([xyz])\b", re.MULTILINE | re.IGNORECASE)
_Z_FROM_Y_UP = {"y": "z", "-y": "-z", "z": "-y", "-z": "y"}


def axis_warning(path: Path) -> list[str]:
    """What to tell of splats that are taken to be z up, where a comment of Brush in a PLY file says otherwise; it does not say which end
    of the axis is up. The file was read before, and is whole."""
    if found(path) not in (PLY, COMPRESSED_PLY):
        return []
    axis = (last_comment(path, _COMMENT) or b"z").decode().lower()
    if axis == "z":
        return []
    return [f"{path} says that its vertical axis is {axis}, and z is taken to point up; give --up=-{axis}, as most have it, or --up={axis}"]


def said_up(path: Path) -> str | None:
    """The axis that is up by a file's format or by what it says itself: "y" of GLB and SPZ, whose splats, as those of USD that says so, are
    turned from it to z up when they are loaded; None where neither says."""
    form = found(path)
    if form in (GLB, SPZ):
        return "y"
    if form is not USD:
        return None
    from scenes.usd.splats import stage_axes

    return stage_axes(path)[0]


def loaded_axis(path: Path, axis: str) -> str:
    """Where an axis of a file, as "-y", points once its splats are loaded."""
    return _Z_FROM_Y_UP.get(axis, axis) if said_up(path) == "y" else axis
