"""A clip in other colours than its place has: graded as photos that were taken there.

Exposure, white balance, tone and saturation of a whole picture are set by the linear map that moves its colours least to have the mean and
covariance of the photos' (Monge and Kantorovich; Pitié and Kokaram 2007). Of the photos those count that show most nearly the same:
ranks of brightness over a coarse grid tell, which no exposure and no curve of tone changes. Then goes what the clip has of noise and
sharpening beyond those photos (`enhance/correcting/grain.py`). What changes no more than photos as unlike differ among themselves is left
alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional as F

from enhance.alike import LONG, alike
from enhance.correcting.colour_map import SAME, Colours, Map
from enhance.correcting.grain import Excess, Grain, without
from enhance.correcting.objects import LUMA
from enhance.photos import frames_of, shrunk
from enhance.step import Steps, check_rgb, checked
from render.frame_types import Frame
from scenes.pictures import PICTURES

GRID = (12, 20)
"""Blocks, down and across, whose ranks of brightness are compared."""

NEAREST = 3
"""Photos whose colours a frame is given: the mean of those that show most nearly the same."""

MOST = 200
"""Photos of a folder that are looked at, spread over all."""

STEADY = 50
"""Frames over which a clip's map is averaged, at most: a camera's settings change slowly."""

STRIDE = 8
"""Every how many frames of a video are looked at."""

OFTEN = 0.9
"""Part of the photos whose excess of grain over others is usual."""

GREY = 2 / 255
"""Most by which a grey photo's channels differ."""


class Grade:
    """Colours and grain of photos of one place.

    grey         whether no photo has any colour
    usual_grain  excess that nine of ten photos have over others
    """

    def __init__(self, photos: Iterable[torch.Tensor]):
        """Of pictures `[H, W, 3]` in 0..1, best as wide as the frames. ValueError where there are none, or one is no such picture."""
        colours, ranks, self.grains, self.grey = [], [], [], True
        for i, photo in enumerate(photos):
            check_rgb(f"photo {i}", photo)
            small = _small(photo)
            colours.append(Colours.of(small.flatten(0, 1)))
            self.grey &= bool((small.amax(-1) - small.amin(-1)).max() < GREY)
            ranks.append(_ranks(small))
            self.grains.append(Grain.of(photo))
        if not colours:
            raise ValueError("there are no photos whose colours could be taken")
        self.colours, self.ranks = colours, torch.stack(ranks)
        self.usual_grain = Excess(torch.ones(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
        self.apart: list[tuple[np.ndarray, np.ndarray]] = []
        if len(colours) > 1:
            orders = [self._order(i) for i in range(len(colours))]
            self.apart = [self._apart(i, order) for i, order in enumerate(orders)]
            each = [Excess.of(g, self._mean(order[:NEAREST])[1]) for g, order in zip(self.grains, orders, strict=True)]
            self.usual_grain = Excess(*(torch.stack(x).quantile(OFTEN, 0) for x in zip(*((e.gain, e.noise) for e in each), strict=True)))

    @classmethod
    def read(cls, source: str | Path, width: int) -> Grade:
        """Of a picture, the pictures of a folder, or some frames of a video, `width` pixels wide at most. FileNotFoundError where there is
        nothing, ValueError where it holds no photos."""
        if not Path(source).exists():
            raise FileNotFoundError(f"no such photos: {source}")
        photos = (shrunk(photo, width) for photo in frames_of(Path(source), STRIDE, MOST))
        first = next(photos, None)
        if first is None:
            below = next((f.parent for f in sorted(Path(source).rglob("*")) if f.suffix.lower() in PICTURES), None)
            raise ValueError(f"{source} holds no photos ({', '.join(PICTURES)})" + (f"; {below} does" if below else ""))
        return cls(chain([first], photos))

    def nearest(self, ranks: torch.Tensor) -> tuple[Colours, Grain, float]:
        """What a picture with such ranks should have, and how like it the photos are that say so, 1 at most."""
        likeness, best = (self.ranks @ ranks).topk(min(NEAREST, len(self.colours)))
        return *self._mean(best.tolist()), float(likeness.mean())

    def usual(self, likeness: float) -> float:
        """Median mean-square change of a photo that is graded like other photos of a likeness: what differences between photos of one place
        come to. By likeness, since neighbours in a drive are near-duplicates. 0 where there is one photo only."""
        return float(np.median([_expected(1 - likeness, *one) for one in self.apart])) if self.apart else 0.0

    def _apart(self, i: int, order: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """How unlike the nearest photos are, and the mean square by which photo `i` is changed that is given their colours; then of others,
        each time twice as far down the order of likeness: `[T]` each."""
        start, found = 0, []
        while start < len(order):
            those = order[start : start + NEAREST]
            by = Map.between(self.colours[i], self._mean(those)[0])
            found.append((1 - float((self.ranks[those] @ self.ranks[i]).mean()), by.changes(self.colours[i])))
            start = 2 * start or NEAREST
        unlike, changes = np.array(found).T
        return unlike, changes

    def _order(self, i: int) -> list[int]:
        """The other photos, the likest first."""
        return [k for k in (self.ranks @ self.ranks[i]).argsort(descending=True).tolist() if k != i]

    def _mean(self, those: list[int]) -> tuple[Colours, Grain]:
        return Colours.mean_of([self.colours[i] for i in those]), Grain.mean_of([self.grains[i] for i in those])


@dataclass(frozen=True)
class Settled:
    """What is remembered between frames: the means so far of the map, of frames' own grain and of that of photos like them, and of how many
    frames; the last frame in small; and what the enhancer remembers."""

    map: Map
    own: Grain
    grain: Grain
    count: int
    last: torch.Tensor
    inner: Any


class Graded:
    """An enhancer whose input is graded like photos first: `better, memory = graded.step(frame, memory)`. The grade is estimated from the
    frame without its instances; these are graded along with it, and then corrected by the enhancer."""

    def __init__(self, enhancer: Steps, grade: Grade):
        self.enhancer, self.grade = enhancer, grade
        self.about, self.reads, self.device = enhancer.about, enhancer.reads, enhancer.device

    @torch.no_grad()
    def step(self, frame: Frame | torch.Tensor, memory: Settled | None = None) -> tuple[torch.Tensor, Settled]:
        """One frame enhanced; after a cut all is found anew. Raises what the enhancer's step raises."""
        given = checked(frame)
        rgb = given.rgb.to(self.device, torch.float32).clamp(0, 1)
        counts = None if given.instance is None else given.instance.to(self.device) <= 0
        counts = None if counts is None or not counts.any() else counts
        small = _small(rgb)
        last = small.permute(2, 0, 1)[None]
        before = memory if memory is not None and memory.last.shape == last.shape and alike(last, memory.last)[0] else None
        share = 1.0 if before is None else 1 / min(before.count + 1, STEADY)

        colours, grain, likeness = self.grade.nearest(_ranks(small))
        mine = Colours.of(small.flatten(0, 1) if counts is None else _counted(small, counts))
        by = Map.between(mine, colours) if before is None else before.map.toward(Map.between(mine, colours), share)
        change = by.changes(mine)
        surely = max(0.0, 1 - self.grade.usual(likeness) / change) if change > 0 else 0.0
        better = SAME.toward(by, surely)(rgb) if surely else rgb

        own = Grain.of(better, counts)
        own, grain = (own, grain) if before is None else (before.own.toward(own, share), before.grain.toward(grain, share))
        excess = Excess.of(own, grain).beyond(self.grade.usual_grain)
        better = without(better, excess) if excess.any() else better

        better, inner = self.enhancer.step(
            replace(frame, rgb=better) if isinstance(frame, Frame) else better, None if memory is None else memory.inner
        )
        return better, Settled(by, own, grain, 1 if before is None else min(before.count + 1, STEADY), last, inner)


def _expected(so_unlike: float, unlike: np.ndarray, changes: np.ndarray) -> float:
    """Mean square of a photo's change by others that are so unlike it: between those that are less and more so, `[T]`; where all are less,
    in proportion."""
    return float(np.interp(so_unlike, unlike, changes)) * max(1.0, so_unlike / max(unlike[-1], 1e-9))


def _counted(small: torch.Tensor, counts: torch.Tensor) -> torch.Tensor:
    """Of a picture in small the pixels `[N, 3]` that count throughout; all where none does."""
    known = _small(counts[..., None].to(small)).flatten() > 0.99
    pixels = small.flatten(0, 1)
    return pixels[known] if known.any() else pixels


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
