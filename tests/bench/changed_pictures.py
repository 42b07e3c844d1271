"""A drive whose pictures are otherwise; `repainted` makes any such."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from functools import cache, partial
from io import BytesIO

import numpy as np
import torch
from PIL import Image

from recon.log import Log, LogCamera, Packed
from scenes.sky import linear_from_srgb, srgb_from_linear
from tests.bench.changes import change

PHOTONS = 4000
"""Those that a white pixel counts, where nothing is darker."""

SPOTS = ((0.20, 0.25), (0.45, 0.60), (0.70, 0.35), (0.85, 0.75))
"""Of dirt: parts of a picture's width and height from its upper left corner."""

SPOT, TAKEN = 0.025, 0.7
"""A spot's standard deviation in widths of the picture, and the part of the light that its middle takes."""

STOP, STOPS = 1.3, 3
"""By what factor, and how many times at most, a picture is darker than the brightest."""

Paint = Callable[[np.ndarray, int], np.ndarray]
"""A picture, uint8 `[H, W, 3]`, and its number -> the same otherwise."""


def repainted(log: Log, what: str, paint: Paint, names: Collection[str] | None = None, **saved) -> Log:
    """The drive with the pictures of its cameras, of all or of those named, painted anew as they are read, which messages call `what`.
    saved: how Pillow is to save them, without loss by default."""

    def camera(c: LogCamera) -> LogCamera:
        files = tuple(Packed(f"{file}, {what}", partial(_painted, c, i, paint, saved)) for i, file in enumerate(c.files))
        return replace(c, files=files)

    return replace(log, cameras={name: camera(c) if names is None or name in names else c for name, c in log.cameras.items()})


def _painted(camera: LogCamera, index: int, paint: Paint, saved: dict) -> bytes:
    packed = BytesIO()
    Image.fromarray(np.ascontiguousarray(paint(camera.image(index), index))).save(packed, **(saved or {"format": "BMP"}))
    return packed.getvalue()


@cache
def _linear() -> np.ndarray:
    """Light, float32 from 0 to 1, of each level of a picture."""
    return linear_from_srgb(torch.arange(256) / 255).numpy()


def _levels(light: np.ndarray) -> np.ndarray:
    return (srgb_from_linear(torch.from_numpy(light).float()).clamp(0, 1) * 255).round().byte().numpy()


@change()
def dark(log: Log) -> Log:
    """Four stops darker, with the noise of 250 photons in white, lifted by two stops."""

    def paint(picture: np.ndarray, index: int) -> np.ndarray:
        counted = np.random.default_rng(index).poisson(_linear()[picture] * PHOTONS / 2**4)
        return _levels(counted / PHOTONS * 2**2)

    return repainted(log, "dark", paint)


@change()
def dirt(log: Log) -> Log:
    """Four soft dark spots of dirt on the lens."""

    def paint(picture: np.ndarray, index: int) -> np.ndarray:
        height, width = picture.shape[:2]
        y, x = np.mgrid[:height, :width].astype(np.float32)
        passing = np.ones((height, width), np.float32)
        for across, down in SPOTS:
            passing *= 1 - TAKEN * np.exp(-((x - across * width) ** 2 + (y - down * height) ** 2) / (2 * (SPOT * width) ** 2))
        return _levels(_linear()[picture] * passing[..., None])

    return repainted(log, "with dirt", paint)


def darker(index: int) -> int:
    """How many times a picture is darker by `STOP`, where exposure jumps: one more or less than that before it."""
    walked = int(np.random.default_rng(0).choice([-1, 1], index + 1).sum()) % (2 * STOPS)
    return min(walked, 2 * STOPS - walked)


@change()
def exposure(log: Log) -> Log:
    """Exposure that jumps by a factor of 1.3 from each picture to the next, up or down at random, 2.2 in all."""
    return repainted(log, "otherwise exposed", lambda picture, index: _levels(_linear()[picture] / STOP ** darker(index)))


@change()
def jpeg(log: Log) -> Log:
    """Pictures as JPEG of quality 20."""
    return repainted(log, "pressed", lambda picture, index: picture, format="JPEG", quality=20)
