"""Photos, folders of photos and videos as right pictures: to learn from, and to grade a clip like."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
import torch
from torch.nn import functional as F

from enhance.pictures import in_order
from render.video import read_image, read_video
from scenes.pictures import PICTURES
from scenes.spread import spread

SMALLEST = 16
"""Pixels of a photo's shorter side, at least."""


class Photos:
    """Real frames beside the pairs: folders of images, and videos of which every `stride`-th frame is kept, as bytes in a temporary file
    (where `TMPDIR` says): of a long video they are more than memory holds. frames: uint8 `[H, W, 3]` each, read as they are looked at."""

    def __init__(self, paths: tuple[str | Path, ...], stride: int = 8, width: int = 960):
        shapes = []
        with TemporaryFile() as file:
            for photo in (photo for path in paths for photo in photos_of(Path(path), stride, width)):
                shapes.append(photo.shape)
                file.write(photo.tobytes())
            file.flush()
            kept = np.asarray(np.memmap(file, np.uint8, "c"))  # which outlives the file's name
        ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]
        self.frames: list[np.ndarray] = [part.reshape(shape) for part, shape in zip(np.split(kept, ends), shapes, strict=True)]

    def crop(self, rng: np.random.Generator, size: int) -> torch.Tensor:
        """A crop `[3, size, size]` of one photo, as it is or shrunk."""
        photo = self.frames[rng.integers(len(self.frames))]
        n = int(size * min(float(rng.choice([1.0, 1.0, 1.5, 2.0])), min(photo.shape[:2]) / size))
        y, x = (int(rng.integers(side - n + 1)) for side in photo.shape[:2])
        rgb = torch.from_numpy(photo[y : y + n, x : x + n]).permute(2, 0, 1).float() / 255
        return rgb if n == size else F.interpolate(rgb[None], (size, size), mode="area")[0]


def photos_of(path: Path, stride: int, width: int) -> Iterator[np.ndarray]:
    """The frames of a path, uint8 `[H, W, 3]`, `width` pixels wide at most, one after the other. ValueError for one that is too small to
    tell, and where there is none."""
    count = 0
    for count, frame in enumerate(frames_of(path, stride), 1):  # noqa: B007 - asked for after the last
        if min(frame.shape[:2]) < SMALLEST:
            raise ValueError(f"{path} holds a picture of {frame.shape[1]}x{frame.shape[0]} pixels, too small to tell; leave it out")
        yield (shrunk(frame, width) * 255).round().to(torch.uint8).numpy()
    if count == 0:
        raise ValueError(f"{path} holds no photos; give a folder of {', '.join(PICTURES)} or a video")


def frames_of(path: Path, stride: int, most: int | None = None) -> Iterator[torch.Tensor]:
    """Of a picture that, of a folder its pictures, `most` of them spread over all, of a video every `stride`-th frame: `[H, W, 3]`."""
    if path.is_dir():
        files = sorted(in_order(path, PICTURES))
        yield from map(read_image, files if most is None else spread(files, most))
    elif path.suffix.lower() in PICTURES:
        yield read_image(path)
    else:
        yield from islice(read_video(path), 0, None, stride)


def shrunk(frame: torch.Tensor, width: int) -> torch.Tensor:
    """A picture `[H, W, 3]` that is at most so wide; a photo is never enlarged."""
    h, w = frame.shape[:2]
    if w <= width:
        return frame
    return F.interpolate(frame.permute(2, 0, 1)[None], (round(h * width / w), width), mode="area")[0].permute(1, 2, 0)
