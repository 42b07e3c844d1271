"""A picture's pixels out of its file: 8-bit RGB, whatever the file holds, as every reader here takes them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

import numpy as np
from PIL import Image

PICTURES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
"""Suffixes of what is taken for a picture; whatever else is one file is taken for a video."""

ORIENTATION, TURNED = 0x0112, range(2, 9)
"""EXIF's tag that says how a picture is to be turned, and its values that turn or mirror it."""

SIDEWAYS = range(5, 9)
"""Those that make its width its height."""


@contextmanager
def opened(file: str | os.PathLike | IO[bytes], name: str, fix: str) -> Iterator[Image.Image]:
    """An image file, whose pixels are decoded when the block asks for them. ValueError with its name and the fix where that fails, also for
    a header that claims more pixels than any picture has; FileNotFoundError passes."""
    try:
        with Image.open(file) as picture:
            yield picture
    except FileNotFoundError:
        raise
    except (OSError, SyntaxError, EOFError, ValueError, Image.DecompressionBombError) as problem:
        raise ValueError(f"{name} does not decode as an image ({problem}); {fix}") from None


def rgb_of(picture: Image.Image) -> Image.Image:
    """An opened picture as 8-bit RGB, as it is stored. 16-bit grey is scaled: PIL alone would make all of it that is not black white.
    ValueError for floats, of which PIL would make black."""
    if picture.mode.startswith("F"):
        raise ValueError("its values are floats, of which nothing says what is white: store it with 8 or 16 bits")
    if picture.mode.startswith("I"):
        levels = np.asarray(picture).clip(0, 65535) / 257
        picture = Image.fromarray(np.round(levels).astype(np.uint8))
    return picture.convert("RGB")


def dropped_of(picture: Image.Image) -> str:
    """What `rgb_of` leaves out of an opened picture, '' for nothing: its alpha channel, what its values have beyond 8 bits, or further
    pictures of its file."""
    finer = picture.mode[0] in "IF" or any(";16" in str(tile[3]) for tile in getattr(picture, "tile", ()))
    return unread(picture.has_transparency_data, finer, count_of(picture))


def unread(alpha: bool, finer: bool, count: int = 1) -> str:
    """What one picture of 8-bit RGB has no place for, in words."""
    further = [f"all but the first of its {count} pictures"] * (count > 1)
    return " and ".join(["its alpha channel"] * alpha + ["all beyond 8 bits of its values"] * finer + further)


def count_of(picture: Image.Image) -> int:
    """How many pictures an opened file holds, one after another, as animations and scans do. A camera's MPO counts as one: what follows
    there is the same picture again, in small or as another lens saw it."""
    return 1 if picture.format == "MPO" else getattr(picture, "n_frames", 1)


def is_turned(picture: Image.Image) -> bool:
    """Whether an opened picture is stored otherwise than it is to be seen, as phones store portraits."""
    return picture.getexif().get(ORIENTATION, 1) in TURNED


def swaps_sides(picture: Image.Image) -> bool:
    """Whether an opened picture is as wide as it is to be seen high."""
    return picture.getexif().get(ORIENTATION, 1) in SIDEWAYS
