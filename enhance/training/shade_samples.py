"""Objects with and without their shadow, drawn for training: of the stored clips into which an asset was put."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from enhance.batch import Batch
from enhance.correcting.outlines import boxes
from enhance.correcting.shade import DOWN, SEEN, at_most, read_ground
from enhance.pairs.isp import random_isp
from enhance.pairs.shards import Shard

PIXELS = 256
"""Pixels of the ground by which a shadow is judged."""
EVERY = 2
"""Every how many frames of a clip its objects are read."""
SHARES = {"missing": 0.42, "there": 0.29, "own": 0.29}
"""How often a put-in object without its shadow is drawn, one with it, and one that stood there."""
NOISE = 0.05
"""Spread of an error of what is read."""


@dataclass(frozen=True)
class Grounds(Batch):
    """What is read of the ground by B objects `[B, READ]`, and pixels of it `[B, PIXELS, 3]` as given and as they should be, at `places`
    `[B, PIXELS, 2]`."""

    read: torch.Tensor
    places: torch.Tensor
    given: torch.Tensor
    target: torch.Tensor


class ShadeSampler:
    """Reads all objects of the clips once, when first asked, plain and mirrored in other light; draws batches of them."""

    def __init__(self, shards: Sequence[Shard], seed: int):
        self.shards, self.seed = shards, seed
        self.found: dict[str, list[tuple]] | None = None

    def draw(self, rng: np.random.Generator, count: int) -> Grounds | None:
        """None where no clip has an asset put in."""
        if self.found is None:
            self.found = self._all()
        kinds = [kind for kind in SHARES if self.found[kind]]
        if not kinds:
            return None
        share = np.array([SHARES[kind] for kind in kinds])
        drawn = [self.found[kind] for kind in rng.choice(kinds, count, p=share / share.sum())]
        read, *pixels = (torch.stack(part) for part in zip(*(of[rng.integers(len(of))] for of in drawn), strict=True))
        noise = torch.from_numpy(rng.normal(0, NOISE, read.shape).astype(np.float32))
        return Grounds(read + noise, *pixels)

    def _all(self) -> dict[str, list[tuple]]:
        found: dict[str, list[tuple]] = {kind: [] for kind in SHARES}
        rng = np.random.default_rng([self.seed, 11])
        for shard in self.shards:
            (mine,) = shard.meta["instances"]
            for t in range(0, shard.frames, EVERY):
                bare, instance = shard.frame("input", t)
                right, _ = shard.frame("target", t)
                instance = torch.where(instance == 255, 0, instance.int())
                for i, box in boxes(instance).items():
                    places, at = box.places(instance[box.outer_rows, box.outer_columns] == 0)
                    if len(places) < PIXELS:
                        continue
                    strips = [picture[at].T[:, None].float() / 255 for picture in (bare, right)]
                    for kind, (given, target) in {"missing": (0, 1), "there": (1, 1)}.items() if i == mine else {"own": (0, 0)}.items():
                        found[kind] += _twice(rng, strips[given], strips[target], places)
        return found


def _twice(rng: np.random.Generator, given: torch.Tensor, target: torch.Tensor, places: torch.Tensor) -> list[tuple]:
    """Ground `[3, 1, N]` plain, and mirrored with the picture in other colours."""
    grade, out = random_isp(rng, 0.7), []
    for a, b, where in ((given, target, places), (grade(given), grade(target), places * torch.tensor([1.0, -1.0]))):
        k = torch.from_numpy(rng.integers(len(where), size=PIXELS))
        low = (where[:, 0] > DOWN[0]).nonzero()[:, 0]
        at = low[at_most(SEEN, len(low), low.device)]
        read = read_ground(a[None, :, 0, at].mT, where[None, at], torch.ones(1, len(at), dtype=torch.bool))[0]
        out.append((read, where[k], a[:, 0, k].T, b[:, 0, k].T))
    return out
