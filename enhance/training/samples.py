"""Training samples: crops of stored pairs and of photos, flipped and in other colours each time they are drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch.nn import functional as F

from enhance.batch import Batch
from enhance.pairs.isp import random_isp
from enhance.pairs.shards import KINDS, RENDERED, PairSet, Shard, Window
from enhance.photos import Photos
from enhance.training.object_samples import Objects, ObjectSampler
from enhance.training.shade_samples import Grounds, ShadeSampler

KIND_WEIGHTS = {"underfit": 0.4, "sparse": 0.3, "cycle": 0.2, "crossref": 0.1}
"""How often the network sees rendered kinds; most of what crossref lacks nobody can know."""
PLACED = ("relight", "shadow", "reinsert")
"""Kinds that change a part of the frame."""
PHOTOGRAPHED = 0.4  # how often a right picture is one of the further photos, where there are some
MASK_KNOWN = 0.5  # how often training tells the network where the instances are
REFERENCED = 0.5  # how often a rendered frame comes as photos beside it have bettered it


@dataclass(frozen=True)
class Sample(Batch):
    """Rendered frames for the network, `[B, T, C, h, w]` each: input, target, mask (objects' ids from 1, NaN where not told), flow,
    visible, and the reference that was laid into the input, with its trust, 0 where none was."""

    input: torch.Tensor
    target: torch.Tensor
    mask: torch.Tensor
    flow: torch.Tensor
    visible: torch.Tensor
    reference: torch.Tensor
    trust: torch.Tensor


@dataclass(frozen=True)
class Images(Batch):
    """Pictures `[B, 3, h, w]`."""

    rgb: torch.Tensor


class Sampler:
    """Draws samples. The draw depends on the seed and the step alone, so a resumed training sees what an unbroken one sees."""

    def __init__(self, pairs: PairSet | None, photos: Photos | None, seed: int, kinds: Sequence[str] = KINDS):
        if pairs is None and photos is None:
            raise ValueError("there is nothing to train on: give pairs, photos or both")
        self.photos, self.seed = photos, seed
        self.shards = {kind: pairs.of(kind, "train") if pairs and kind in kinds else [] for kind in KINDS}
        for kind in PLACED:  # where nothing could be changed, there is nothing to learn
            self.shards[kind] = [s for s in self.shards[kind] if s.meta.get("instances")]
        self.rendered = [kind for kind in RENDERED if self.shards[kind]]
        self.longest = max((s.frames for kind in self.rendered for s in self.shards[kind]), default=1)
        self._shade = ShadeSampler(self.shards["shadow"], seed)
        self.has_objects = photos is not None or bool(self.shards["clean"] or self.shards["isp"])
        self._objects = ObjectSampler(self.shards, photos.frames if photos else [], "isp" in kinds)
        if pairs and not any(self.shards.values()) and photos is None:
            raise ValueError('the pairs hold no clip of split "train"; make pairs of more cameras than the held-out one')

    def rng(self, step: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, step])

    def images(self, step: int, count: int, size: int) -> Images:
        """Crops for the autoencoder, of right pictures and of renders, some in other colours."""
        rng = self.rng(step)
        rendered = [bool(self.rendered) and rng.random() < 0.3 for _ in range(count)]
        images = [self._rendered(rng, 1, size).input[0] if one else self._right(rng, size) for one in rendered]
        return Images(torch.stack([random_isp(rng)(image) if rng.random() < 0.4 else image for image in images]))

    def right(self, step: int, count: int, size: int) -> Images:
        """Crops of right pictures, some in other colours."""
        rng = self.rng(step)
        images = [self._right(rng, size) for _ in range(count)]
        return Images(torch.stack([random_isp(rng, 0.7)(image) if rng.random() < REGRADED else image for image in images]))

    def batch(self, step: int, count: int, frames: int, size: int) -> Sample:
        """`count` clips of `frames` frames, of all rendered kinds."""
        rng = self.rng(step)
        drawn = [self._sample(rng, frames, size) for _ in range(count)]
        return Sample(**{f.name: torch.stack([getattr(s, f.name) for s in drawn]) for f in fields(Sample)})

    def objects(self, step: int, count: int, progress: Callable[[int], None] | None = None) -> Objects:
        """Objects in wrong colours or in their own; `progress` is called with how many are drawn."""
        return self._objects.draw(self.rng(step), count, progress)

    def grounds(self, step: int, count: int) -> Grounds | None:
        """Ground by objects with and without their shadow."""
        return self._shade.draw(self.rng(step), count)

    def _sample(self, rng: np.random.Generator, frames: int, size: int) -> Sample:
        w = _regraded(rng, self._rendered(rng, frames, size))
        trust = w.trust if rng.random() < REFERENCED else torch.zeros_like(w.trust)
        damaged = (torch.lerp(w.input, w.reference, trust) * 255).round() / 255
        objects = w.instance.clamp_min(0).float()
        mask = objects if rng.random() < MASK_KNOWN else torch.full_like(objects, torch.nan)
        return _flipped(rng, Sample(damaged, w.target, mask, w.flow, w.visible, w.reference * (trust > 0), trust))

    def _rendered(self, rng: np.random.Generator, frames: int, size: int) -> Window:
        able = {kind: some for kind in self.rendered if (some := [s for s in self.shards[kind] if s.frames >= frames])}
        weights = np.array([KIND_WEIGHTS[k] for k in able])
        shards = list(able.values())[rng.choice(len(weights), p=weights / weights.sum())]
        return _crop(rng, shards[rng.integers(len(shards))], frames, size)

    def _right(self, rng: np.random.Generator, size: int) -> torch.Tensor:
        stored = [s for of in self.shards.values() for s in of]
        if self.photos is not None and (not stored or rng.random() < PHOTOGRAPHED):
            return self.photos.crop(rng, size)
        return _crop(rng, stored[rng.integers(len(stored))], 1, size).target[0]


def _crop(rng: np.random.Generator, shard: Shard, frames: int, size: int) -> Window:
    """A crop of a stored clip anywhere."""
    h, w = min(size, shard.height), min(size, shard.width)
    start, top, left = (int(rng.integers(n + 1)) for n in (shard.frames - frames, shard.height - h, shard.width - w))
    window = shard.window(start, frames, top, left, h, w)
    if (h, w) == (size, size):
        return window
    pad = (0, size - w, 0, size - h)
    return Window(
        **{name: F.pad(getattr(window, name), pad, mode="replicate") for name in ("input", "target", "region", "reference", "trust")},
        instance=F.pad(window.instance, pad, value=-1),
        flow=F.pad(window.flow, pad, value=torch.nan),
        visible=F.pad(window.visible, pad),
    )


REGRADED = 0.65


def _regraded(rng: np.random.Generator, w: Window) -> Window:
    """More often than not the whole picture in other colours, damage and target alike: the network must compare within a picture.

    Without this it learns what the few training places look like, and does harm in any other light.
    """
    if rng.random() >= REGRADED:
        return w
    grade = random_isp(rng, 0.7)
    given = grade(w.input)
    return replace(w, target=grade(w.target), input=given, reference=grade(w.reference) if w.trust.any() else given)


def _flipped(rng: np.random.Generator, sample: Sample) -> Sample:
    if rng.random() < 0.5:
        return sample
    turned = {f.name: getattr(sample, f.name).flip(-1) for f in fields(Sample)}
    turned["flow"] = turned["flow"] * torch.tensor([-1.0, 1.0])[:, None, None]
    return Sample(**turned)
