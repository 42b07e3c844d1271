"""Where objects were put into the pictures of a clip, as files tell it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from enhance.pictures import in_order
from scenes.pictures import opened

KINDS = (".npy", ".png")
MOST = 64
"""Objects of one picture; where more are told, a mask's soft edges most likely count as objects of their own."""


class ObjectIds:
    """A folder of .png or .npy, one a picture of the clip, in the order of the numbers in their names.

    Numbers above 0 of arrays, of grey and of palette pictures are objects' ids, and each colour but black of coloured ones is an object;
    what `sidestep render --outputs instance` keeps is read, too, and all of its actors count as put in. pictures: how many the clip has,
    where that is known. ValueError where there are none, or not as many.
    """

    def __init__(self, folder: str | Path, pictures: int | None = None):
        self.folder, self.files = Path(folder), in_order(Path(folder), KINDS)
        if not self.files:
            below = min((f.parent for f in self.folder.rglob("*") if f.suffix.lower() in KINDS), key=_instances_first, default=None)
            told = f"{folder} holds no {' or '.join(KINDS)} that say where objects were put in, one a picture"
            raise ValueError(told + (f"; {below} does" if below else ""))
        if pictures is not None:
            self.check_count(pictures)

    def check_count(self, pictures: int) -> None:
        """ValueError unless there are ids for as many pictures as the clip has."""
        if pictures != len(self.files):
            raise ValueError(f"{self.folder} has ids for {len(self.files)} pictures, and the clip has {pictures}; give one file a picture")

    def of(self, number: int, width: int, height: int) -> torch.Tensor:
        """int32 `[height, width]` of a picture, 0 where nothing was put in."""
        if number >= len(self.files):
            raise ValueError(f"{self.folder} has ids for {len(self.files)} pictures, and the clip has more; give one file a picture")
        file = self.files[number]
        ids = _array(file) if file.suffix.lower() == ".npy" else _picture(file)
        if ids.shape != (height, width):
            fix = f"resize them to {width}x{height} by nearest neighbour, which mixes no ids" if ids.ndim == 2 else "give one id a pixel"
            raise ValueError(f"{file} has ids of the shape {list(ids.shape)}, but its picture is {height} rows of {width}; {fix}")
        if (count := len(np.unique(ids[ids > 0]))) > MOST:
            fix = "give every object one value, without soft edges"
            raise ValueError(f"{file} has {count} objects, and a picture may have {MOST} at most; {fix}")
        return torch.from_numpy(ids.astype(np.int32))


def _instances_first(folder: Path) -> tuple[bool, Path]:
    """A key that sorts folders as they may hold ids: `sidestep render` keeps an output in a folder of its name."""
    return folder.name != "instance", folder


def _array(file: Path) -> np.ndarray:
    try:
        ids = np.load(file, mmap_mode="r", allow_pickle=False)  # nothing is reserved, whatever size a damaged header tells
    except (ValueError, EOFError, OSError) as problem:
        raise ValueError(f"{file} is not an array of numpy's ({problem}); write it again") from None
    if ids.dtype == bool:
        return ids.astype(np.int32)
    if not np.issubdtype(ids.dtype, np.integer) or (
        ids.size and (ids.max() > np.iinfo(np.int32).max or ids.min() < np.iinfo(np.int32).min)
    ):
        raise ValueError(f"{file} holds {ids.dtype}; ids are whole numbers below 2^31")
    return ids


def _picture(file: Path) -> np.ndarray:
    with opened(file, str(file), "write it again") as picture:
        if picture.mode in ("1", "L", "P", "I;16", "I"):
            return np.asarray(picture).astype(np.int64)
        red, green, blue = np.moveaxis(np.asarray(picture.convert("RGB")).astype(np.int64), -1, 0)
        return red << 16 | green << 8 | blue
