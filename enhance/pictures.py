"""A clip as a folder of pictures, read and written as a video is (`render/video.py`)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import torch

from recon.readers.order import recorded
from render.video import CONTAINERS, read_image, write_image
from scenes.atomic import atomic_folder
from scenes.pictures import PICTURES, dropped_of, opened


class Pictures:
    """The pictures of a folder, in the order of the numbers in their names; iterate over `timed` for rgb `[H, W, 3]` float32 0..1.

    width, height: pixels; count: how many there are; dropped: what is not read of which picture, in words, or ''.
    ValueError where there are none, two have one name but for its end, or one is of another size.
    """

    def __init__(self, folder: str | Path):
        self.path = Path(folder)
        self.files = in_order(self.path, PICTURES)
        if not self.files:
            raise ValueError(f"{folder} holds no pictures ({', '.join(PICTURES)}), and is no video")
        for one, other in pairwise(sorted(self.files, key=lambda file: (file.stem, file))):
            if one.stem == other.stem:
                raise ValueError(f"{folder} holds {one.name} and {other.name}, which would both become {one.stem}.png; take one out")
        self.count = len(self.files)
        self.height, self.width = read_image(self.files[0]).shape[:2]
        self.dropped = next((f"of {file.name} {what}" for file in self.files if (what := _dropped(file))), "")

    def timed(self) -> Iterator[tuple[int, torch.Tensor]]:
        """The pictures, each after its number."""
        for i, file in enumerate(self.files):
            rgb = read_image(file)
            if rgb.shape[:2] != (self.height, self.width):
                sizes = f"{rgb.shape[1]}x{rgb.shape[0]}, {self.files[0].name} {self.width}x{self.height}"
                raise ValueError(f"{file} is {sizes}; a clip's pictures are of one size")
            yield i, rgb


class PictureWriter:
    """Writes pictures as PNG under given names; the folder appears whole when the block ends, or not at all, and replaces what is there."""

    def __init__(self, folder: str | Path, names: list[str]):
        if Path(folder).suffix.lower() in CONTAINERS:
            raise ValueError(f"{folder} would be a video; pictures become pictures: name a folder, as -o {Path(folder).with_suffix('')}")
        self.path, self.names = Path(folder), names
        if self.path.exists():
            other = next((f for f in self.path.iterdir() if f.suffix.lower() != ".png"), None) if self.path.is_dir() else self.path
            if other is not None:
                raise FileExistsError(
                    f"{folder} would be replaced, and holds more than pictures ({other.name}); name another folder with -o"
                )
        self._stack = ExitStack()

    def __enter__(self) -> PictureWriter:
        self._partial = self._stack.enter_context(atomic_folder(self.path, replace=True))
        return self

    def write(self, rgb: torch.Tensor, number: int) -> None:
        write_image(self._partial / f"{self.names[number]}.png", rgb)

    def __exit__(self, *problem) -> None:
        self._stack.__exit__(*problem)


def _dropped(file: Path) -> str:
    with opened(file, str(file), "fetch or export it again") as picture:
        return dropped_of(picture)


def in_order(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """A folder's files of these kinds, by the numbers in their names. FileNotFoundError where there is no such folder."""
    if not folder.is_dir():
        raise FileNotFoundError(f"no such folder: {folder}")
    return sorted(
        (f for f in folder.iterdir() if f.suffix.lower() in suffixes and not f.name.startswith(".")), key=lambda f: recorded(f.name)
    )
