"""Which axis of a file's splats its header calls vertical."""

from __future__ import annotations

import re
from pathlib import Path

from scenes.formats import COMPRESSED_PLY, PLY, found
from scenes.formats.ply import last_comment

_COMMENT = re.compile(rb"^comment[ \t]+vertical axis:[ \t]*([xyz])\b", re.MULTILINE | re.IGNORECASE)


def axis_warning(path: Path) -> list[str]:
    """What to tell of splats that are taken to be z up, where a comment of Brush in a PLY file says otherwise; it does not say which end
    of the axis is up. The file was read before, and is whole."""
    if found(path) not in (PLY, COMPRESSED_PLY):
        return []
    axis = (last_comment(path, _COMMENT) or b"z").decode().lower()
    if axis == "z":
        return []
    return [f"{path} says that its vertical axis is {axis}, and z is taken to point up; give --up=-{axis}, as most have it, or --up={axis}"]
