"""A clip in other colours than its place has: graded as photos that were taken there.

Exposure, white balance, tone and saturation of a whole picture are set by the linear map that moves its colours least to have the mean and
covariance of the photos' (Monge and Kantorovich; Pitié and Kokaram 2007, eq. 4). Of the photos those count that show most nearly the same:
ranks of brightness over a coarse grid tell, which no exposure and no curve of tone changes. A map that changes no more than the photos
differ among themselves is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional as F

from enhance.objects import LUMA
from enhance.past import LONG, alike
from enhance.samples import PHOTO_SUFFIXES, Photos
from enhance.step import Steps, checked
from render.frame_types import Frame
from render.video import read_image
from scenes.spread import spread

GRID = (12, 20)
"""Blocks, down and across, whose ranks of brightness are compared."""

NEAREST = 3
"""Photos whose colours a frame is given: the mean of those that show most nearly the same."""

MOST = 200
"""Photos that are kept, spread over all."""

STEADY = 50
"""Frames over which a clip's map is averaged, at most: a camera's settings change slowly."""

FLAT = 1e-4
"""Variance that every picture is taken to have in all directions, so that a grey one has a map."""

STRETCH = 4.0
"""Times that a map makes differences of colours larger or smaller, at most: beyond, it is noise that grows."""


@dataclass(frozen=True)
class Colours:
    """Mean `[3]` and covariance `[3, 3]` of a picture's colours, float64."""

    mean: torch.Tensor
    spread: torch.Tensor

    @classmethod
    def of(cls, rgb: torch.Tensor) -> Colours:
        """Of pixels `[N, 3]`."""
        rgb = rgb.double().cpu()
        mean = rgb.mean(0)
        return cls(mean, (rgb - mean).T @ (rgb - mean) / max(len(rgb), 1))

    @classmethod
    def mean_of(cls, several: Sequence[Colours]) -> Colours:
        return cls(torch.stack([c.mean for c in several]).mean(0), torch.stack([c.spread for c in several]).mean(0))


@dataclass(frozen=True)
class Map:
    """rgb -> matrix rgb + offset; float64 `[3, 3]`, `[3]`."""

    matrix: torch.Tensor
    offset: torch.Tensor

    @classmethod
    def between(cls, given: Colours, wanted: Colours) -> Map:
        """From colours to colours by the shortest way."""
        grey = FLAT * torch.eye(3, dtype=torch.float64)
        root = _power(given.spread + grey, 0.5)
        back = _power(given.spread + grey, -0.5)
        matrix = back @ _power(root @ (wanted.spread + grey) @ root, 0.5) @ back
        values, axes = torch.linalg.eigh(matrix)
        matrix = axes @ torch.diag(values.clamp(1 / STRETCH, STRETCH)) @ axes.T
        return cls(matrix, wanted.mean - matrix @ given.mean)

    def changes(self, colours: Colours) -> float:
        """Mean square of what it changes in a picture of such colours."""
        by = self.matrix - torch.eye(3, dtype=torch.float64)
        return float((by @ colours.spread @ by.T).trace() + (by @ colours.mean + self.offset).square().sum()) / 3

    def toward(self, other: Map, share: float) -> Map:
        return Map(torch.lerp(self.matrix, other.matrix, share), torch.lerp(self.offset, other.offset, share))

    def __call__(self, rgb: torch.Tensor) -> torch.Tensor:
        """Of `[..., 3]`, cut to 0..1."""
        return (rgb @ self.matrix.T.to(rgb) + self.offset.to(rgb)).clamp(0, 1)


SAME = Map(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))


class Grade:
    """Colours of photos of one place.

    usual  mean square by which a photo is changed that is given the colours of the others
    """

    def __init__(self, photos: Sequence[torch.Tensor]):
        """Of pictures `[H, W, 3]` in 0..1. ValueError where there are none."""
        if not len(photos):
            raise ValueError("there are no photos whose colours could be taken")
        small = [_small(photo) for photo in photos]
        self.colours = [Colours.of(s.flatten(0, 1)) for s in small]
        self.ranks = torch.stack([_ranks(s) for s in small])
        each = [Map.between(c, self._nearest(r, but=i)).changes(c) for i, (c, r) in enumerate(zip(self.colours, self.ranks, strict=True))]
        self.usual = float(np.median(each)) if len(photos) > 1 else 0.0

    @classmethod
    def read(cls, source: str | Path) -> Grade:
        """Of a picture, the pictures of a folder, or some frames of a video. FileNotFoundError where there is nothing, ValueError where
        it holds no photos."""
        if not Path(source).exists():
            raise FileNotFoundError(f"no such photos: {source}")
        if Path(source).suffix.lower() in PHOTO_SUFFIXES:
            return cls([read_image(source)])
        return cls([torch.from_numpy(photo).float() / 255 for photo in spread(Photos((source,), width=2 * LONG).frames, MOST)])

    def map_for(self, rgb: torch.Tensor, counts: torch.Tensor | None = None) -> tuple[Map, Colours]:
        """What a frame `[H, W, 3]` is to be graded by, and its colours; of those that count, bool `[H, W]`, all where None."""
        small = _small(rgb)
        pixels = small.flatten(0, 1)
        if counts is not None:
            known = _small(counts[..., None].to(rgb)).flatten() > 0.99
            pixels = pixels[known] if known.any() else pixels
        given = Colours.of(pixels)
        return Map.between(given, self._nearest(_ranks(small))), given

    def _nearest(self, ranks: torch.Tensor, but: int | None = None) -> Colours:
        likeness = self.ranks @ ranks
        if but is not None and len(self.colours) > 1:
            likeness[but] = -torch.inf
        count = min(NEAREST, max(1, len(self.colours) - (but is not None)))
        return Colours.mean_of([self.colours[i] for i in likeness.topk(count).indices.tolist()])


@dataclass(frozen=True)
class Settled:
    """What is remembered between frames: the mean of the maps so far, of how many frames, the last frame in small, and what the enhancer
    remembers."""

    map: Map
    count: int
    last: torch.Tensor
    inner: Any


class Graded:
    """An enhancer that is given each frame in the colours of photos: `better, memory = graded.step(frame, memory)`. What is told to have
    been put in does not count; it is graded along, and then the enhancer's."""

    def __init__(self, enhancer: Steps, grade: Grade):
        self.enhancer, self.grade = enhancer, grade
        self.about, self.reads, self.device = enhancer.about, enhancer.reads, enhancer.device

    @torch.no_grad()
    def step(self, frame: Frame | torch.Tensor, memory: Settled | None = None) -> tuple[torch.Tensor, Settled]:
        """One frame enhanced; after a cut the map is found anew. Raises what the enhancer's step raises."""
        given = checked(frame)
        rgb = given.rgb.to(self.device, torch.float32).clamp(0, 1)
        last = _small(rgb).permute(2, 0, 1)[None]
        now, colours = self.grade.map_for(rgb, None if given.instance is None else given.instance.to(self.device) <= 0)
        inner, count = None if memory is None else memory.inner, 0
        if memory is not None and memory.last.shape == last.shape and alike(last, memory.last)[0]:
            count = min(memory.count, STEADY - 1)
            now = memory.map.toward(now, 1 / (count + 1))
        change = now.changes(colours)
        surely = max(0.0, 1 - self.grade.usual / change) if change > 0 else 0.0
        graded = SAME.toward(now, surely)(rgb) if surely else rgb
        better, inner = self.enhancer.step(replace(frame, rgb=graded) if isinstance(frame, Frame) else graded, inner)
        return better, Settled(now, count + 1, last, inner)


def _small(image: torch.Tensor) -> torch.Tensor:
    """`[H, W, C]` shrunk by areas, so that noise does not count as colour, to LONG pixels at most."""
    height, width = image.shape[:2]
    share = min(1.0, LONG / max(height, width))
    size = max(1, round(height * share)), max(1, round(width * share))
    return F.adaptive_avg_pool2d(image.permute(2, 0, 1)[None].float(), size)[0].permute(1, 2, 0)


def _ranks(small: torch.Tensor) -> torch.Tensor:
    """Of a picture's blocks, as a unit vector about its mean."""
    luma = F.adaptive_avg_pool2d((small @ small.new_tensor(LUMA))[None, None], GRID).flatten().cpu()
    ranks = luma.argsort(stable=True).argsort().double()
    return F.normalize(ranks - ranks.mean(), dim=0)


def _power(matrix: torch.Tensor, exponent: float) -> torch.Tensor:
    """Of a symmetric positive one."""
    values, axes = torch.linalg.eigh(matrix)
    return axes @ torch.diag(values.clamp_min(1e-12) ** exponent) @ axes.T
