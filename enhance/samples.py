"""Training samples: crops of stored pairs and of photos, altered afresh each time they are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional as F

from enhance.ahead import Batch
from enhance.isp import alter, random_isp, random_pipeline
from enhance.masks import random_mask
from enhance.object_samples import Objects, ObjectSampler
from enhance.shade_samples import Grounds, ShadeSampler
from enhance.shards import KINDS, RENDERED, PairSet, Shard, Window

KIND_WEIGHTS = {
    "underfit": 0.2, "sparse": 0.1, "cycle": 0.1, "crossref": 0.05,
    "isp": 0.13, "isp_frame": 0.07, "relight": 0.1, "shadow": 0.14, "reinsert": 0.06, "clean": 0.12,
}  # fmt: skip
AFRESH = ("isp", "isp_frame", "clean")
"""Kinds that are made of any clip's targets each time anew; of the others the stored frames are drawn."""
PLACED = ("relight", "shadow", "reinsert")
"""Kinds that change a part of the frame; crops look for it."""
AIMED = 0.8  # how often
MASK_KNOWN = 0.5  # how often training tells the network where the instances are
REFERENCED = 0.5  # how often a rendered frame comes as photos beside it have bettered it
ALIEN = 254
"""Id of an object that is none of the scene's."""
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")


@dataclass(frozen=True)
class Sample(Batch):
    """Frames for the network, `[B, T, C, h, w]` each: input, target, region, mask (objects' ids from 1, NaN where not told), flow,
    visible."""

    input: torch.Tensor
    target: torch.Tensor
    region: torch.Tensor
    mask: torch.Tensor
    flow: torch.Tensor
    visible: torch.Tensor


@dataclass(frozen=True)
class Images(Batch):
    """Pictures `[B, 3, h, w]`."""

    rgb: torch.Tensor


class Photos:
    """Real frames beside the pairs: folders of images, and videos of which every `stride`-th frame is kept in memory as bytes."""

    def __init__(self, paths: tuple[str | Path, ...], stride: int = 8, width: int = 960):
        self.frames: list[np.ndarray] = []
        for path in map(Path, paths):
            before = len(self.frames)
            self.frames += [_shrink(frame, width) for frame in _frames(path, stride)]
            if len(self.frames) == before:
                raise ValueError(f"{path} holds no photos; give a folder of {', '.join(PHOTO_SUFFIXES)} or a video")

    def window(self, rng: np.random.Generator, frames: int, size: int) -> Window:
        """A crop that pans by whole pixels over one photo: `frames` frames whose flow is exact."""
        photo = self.frames[rng.integers(len(self.frames))]
        zoom = min(float(rng.choice([1.0, 1.0, 1.5, 2.0])), min(photo.shape[:2]) / size)
        n = int(size * zoom)
        step = rng.integers(-6, 7, 2) if frames > 1 else np.zeros(2, int)
        room = (np.array(photo.shape[:2]) - n) // frames
        step = np.clip(step, -room, room)
        span = np.abs(step) * (frames - 1)
        first = rng.integers(np.array(photo.shape[:2]) - n - span + 1) + np.where(step < 0, span, 0)
        crops = [photo[y : y + n, x : x + n] for y, x in (first + t * step for t in range(frames))]
        rgb = torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2).float() / 255
        if n != size:
            rgb = F.interpolate(rgb, (size, size), mode="area")
        scale = size / n
        flow = torch.tensor(step[::-1] * scale, dtype=torch.float32)[None, :, None, None].repeat(frames, 1, size, size)
        flow[0] = torch.nan
        seen = torch.ones(frames, 1, size, size)
        seen[0] = 0
        nowhere = torch.zeros_like(seen)
        return Window(rgb, rgb, nowhere, nowhere.to(torch.int16), flow, seen, rgb, nowhere)


class Sampler:
    """Draws samples. The draw depends on the seed and the step alone, so a resumed training sees what an unbroken one sees."""

    def __init__(self, pairs: PairSet | None, photos: Photos | None, seed: int, kinds: Sequence[str] = KINDS):
        if pairs is None and photos is None:
            raise ValueError("there is nothing to train on: give pairs, photos or both")
        self.pairs, self.photos, self.seed, self.kinds = pairs, photos, seed, kinds
        self.shards = {kind: pairs.of(kind, "train") if pairs and kind in kinds else [] for kind in KIND_WEIGHTS}
        for kind in PLACED:  # where nothing could be changed, there is nothing to learn
            self.shards[kind] = [s for s in self.shards[kind] if s.meta.get("instances")]
        self._shade = ShadeSampler(self.shards["shadow"], seed)
        self._objects = ObjectSampler(self.shards, photos.frames if photos else [], "isp" in kinds)
        if pairs and not any(self.shards.values()) and photos is None:
            raise ValueError('the pairs hold no clip of split "train"; make pairs of more cameras than the held-out one')

    def rng(self, step: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, step])

    def images(self, step: int, count: int, size: int) -> Images:
        """Crops for the autoencoder: targets and inputs, some with other colours."""
        rng = self.rng(step)
        kinds = [*AFRESH, *(k for k in RENDERED if self.shards[k])]
        windows = [self._window(rng, kinds[rng.integers(len(kinds))], 1, size) for _ in range(count)]
        images = [w.input[0] if rng.random() < 0.3 else w.target[0] for w in windows]
        return Images(torch.stack([random_isp(rng)(image) if rng.random() < 0.4 else image for image in images]))

    def batch(self, step: int, count: int, frames: int, size: int, kind: str | None = None) -> Sample:
        """`count` clips of `frames` frames, of one kind of damage or of all."""
        rng = self.rng(step)
        drawn = [self._sample(rng, frames, size, kind) for _ in range(count)]
        return Sample(**{f.name: torch.stack([getattr(s, f.name) for s in drawn]) for f in fields(Sample)})

    def objects(self, step: int, count: int) -> Objects:
        """Objects in wrong colours or in their own."""
        return self._objects.draw(self.rng(step), count)

    def grounds(self, step: int, count: int) -> Grounds | None:
        """Ground by objects with and without their shadow."""
        return self._shade.draw(self.rng(step), count)

    def _sample(self, rng: np.random.Generator, frames: int, size: int, kind: str | None) -> Sample:
        kinds = [kind] if kind else [k for k in KIND_WEIGHTS if k in self.kinds and (k in AFRESH or self.shards[k])]
        weights = np.array([KIND_WEIGHTS[k] for k in kinds])
        kind = kinds[rng.choice(len(kinds), p=weights / weights.sum())]
        w = self._window(rng, kind, frames, size)
        if kind != "isp_frame":  # which knows its colours by those of right pictures alone
            w = _regraded(rng, w, made=kind in AFRESH)
        objects = w.instance.clamp_min(0).float()
        if kind == "isp":
            region = self._moving_mask(rng, w)
            damaged, told = alter(w.target, region, random_pipeline(rng)), _with_alien(objects, region)
            if rng.random() < 0.25:
                told = _with_alien(torch.zeros_like(objects), region)
        elif kind == "isp_frame":
            damaged, region = random_pipeline(rng)(w.target), torch.ones_like(w.region)
            told = region * ALIEN
        elif kind in RENDERED:
            damaged, region, told = w.input, torch.ones_like(w.region), objects
            if rng.random() < REFERENCED:
                damaged = torch.lerp(damaged, w.reference, w.trust)
            if "isp" in self.kinds and rng.random() < 0.2:  # an inserted asset in a rendered clip: both kinds of damage at once
                alien = self._moving_mask(rng, w)
                damaged, told = alter(damaged, alien, random_isp(rng)), _with_alien(objects, alien)
        elif kind in PLACED:
            damaged, region, told = w.input, w.region, objects
        else:
            damaged, region = w.target, torch.zeros_like(w.region)
            told = objects if objects.any() and rng.random() < 0.5 else _with_alien(torch.zeros_like(objects), self._moving_mask(rng, w))
        damaged = (damaged * 255).round() / 255
        mask = told if rng.random() < MASK_KNOWN or kind == "isp_frame" else torch.full_like(told, torch.nan)
        return _flipped(rng, Sample(damaged, w.target, region, mask, w.flow, w.visible))

    def _window(self, rng: np.random.Generator, kind: str, frames: int, size: int) -> Window:
        stored = [s for of in self.shards.values() for s in of] if kind in AFRESH else self.shards[kind]
        shards = [s for s in stored if s.frames >= frames]
        if not shards and self.photos is None:
            raise ValueError(f"no training clip has {frames} frames; make pairs of longer clips")
        if self.photos is not None and (not shards or (kind in AFRESH and rng.random() < 0.4)):
            return self.photos.window(rng, frames, size)
        return _crop(rng, shards[rng.integers(len(shards))], frames, size, aimed=kind in PLACED and rng.random() < AIMED)

    def _moving_mask(self, rng: np.random.Generator, w: Window) -> torch.Tensor:
        """A region `[T, 1, h, w]` that follows the content: instances where there are some, else a shape carried along the flow."""
        frames, _, h, width = w.instance.shape
        ids = [int(i) for i in w.instance.unique() if i > 0]
        chosen = [i for i in ids if rng.random() < 0.6]
        if chosen and rng.random() < 0.6:
            mask = torch.isin(w.instance, torch.tensor(chosen, dtype=w.instance.dtype)).float()
            return F.avg_pool2d(mask, 3, 1, 1) if rng.random() < 0.5 else mask
        shape = torch.from_numpy(random_mask(rng, h, width))[None, None]
        masks = [shape]
        for t in range(1, frames):
            drift = torch.nan_to_num(w.flow[t]).mean((1, 2))
            masks.append(torch.roll(masks[-1], (-round(float(drift[1])), -round(float(drift[0]))), (-2, -1)))
        return torch.cat(masks)


def _with_alien(objects: torch.Tensor, region: torch.Tensor) -> torch.Tensor:
    """Ids of objects, and a further one where `region` reaches beyond them."""
    return torch.where((objects == 0) & (region > 0.5), float(ALIEN), objects)


def _crop(rng: np.random.Generator, shard: Shard, frames: int, size: int, aimed: bool) -> Window:
    """A crop of a stored clip anywhere, or, when `aimed`, around some pixel of its changed region."""
    h, w = min(size, shard.height), min(size, shard.width)
    start, top, left = (int(rng.integers(n + 1)) for n in (shard.frames - frames, shard.height - h, shard.width - w))
    changed = shard.changed(start + frames // 2).nonzero() if aimed else torch.zeros(0, 2)
    if len(changed):
        y, x = changed[rng.integers(len(changed))].tolist()
        top, left = (int(np.clip(at - rng.integers(n), 0, side - n)) for at, n, side in ((y, h, shard.height), (x, w, shard.width)))
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


def _regraded(rng: np.random.Generator, w: Window, made: bool) -> Window:
    """Now and then the whole picture in other colours, damage and target alike: the network must compare within a picture.

    Without this it learns what the few training places look like, and does harm in any other light. Of kinds that are `made` of the target
    nothing else is used, and colours take most of a sample's time.
    """
    if rng.random() < 0.35:
        return w
    grade = random_isp(rng, 0.7)
    target = grade(w.target)
    if made:
        return replace(w, target=target)
    given = grade(w.input)
    return replace(w, target=target, input=given, reference=grade(w.reference) if w.trust.any() else given)


def _flipped(rng: np.random.Generator, sample: Sample) -> Sample:
    if rng.random() < 0.5:
        return sample
    turned = {f.name: getattr(sample, f.name).flip(-1) for f in fields(Sample)}
    turned["flow"] = turned["flow"] * torch.tensor([-1.0, 1.0])[:, None, None]
    return Sample(**turned)


def _frames(path: Path, stride: int):
    from render.video import read_image, read_video

    if path.is_dir():
        for file in sorted(path.iterdir()):
            if file.suffix.lower() in PHOTO_SUFFIXES:
                yield read_image(file)
    else:
        for i, frame in enumerate(read_video(path)):
            if i % stride == 0:
                yield frame


def _shrink(frame: torch.Tensor, width: int) -> np.ndarray:
    """Bytes `[h, width, 3]`; a photo is never enlarged."""
    h, w = frame.shape[:2]
    if w > width:
        frame = F.interpolate(frame.permute(2, 0, 1)[None], (round(h * width / w), width), mode="area")[0].permute(1, 2, 0)
    return (frame * 255).round().to(torch.uint8).numpy()
