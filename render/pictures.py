"""A picture's pixels out of its file: 8-bit RGB, whatever the file holds, as every reader here takes them."""

from __future__ import annotations

import numpy as np
from PIL import Image

ORIENTATION, TURNED = 0x0112, range(2, 9)
"""EXIF's tag that says how a picture is to be turned, and its values that turn or mirror it."""

SIDEWAYS = range(5, 9)
"""Those that make its width its height."""


def rgb_of(picture: Image.Image) -> Image.Image:
    """An opened picture as 8-bit RGB, as it is stored. 16-bit grey is scaled: PIL alone would make all of it that is not black white."""
    if picture.mode.startswith("I"):
        levels = np.asarray(picture).clip(0, 65535) / 257
        picture = Image.fromarray(np.round(levels).astype(np.uint8))
    return picture.convert("RGB")


def is_turned(picture: Image.Image) -> bool:
    """Whether an opened picture is stored otherwise than it is to be seen, as phones store portraits."""
    return picture.getexif().get(ORIENTATION, 1) in TURNED


def swaps_sides(picture: Image.Image) -> bool:
    """Whether an opened picture is as wide as it is to be seen high."""
    return picture.getexif().get(ORIENTATION, 1) in SIDEWAYS
