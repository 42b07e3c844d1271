"""Objects in wrong colours, drawn for training: those of stored clips, and any region of a photo, each time altered anew."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch.nn import functional as F

from enhance.correcting.objects import PIXELS, Evidence, Objects, evidence, grid_of, spots, whole_of
from enhance.correcting.outlines import Box, Outline, Outlines, boxes, reaching_over
from enhance.pairs.isp import alter, random_isp
from enhance.pairs.masks import random_mask
from enhance.pairs.shards import RENDERED, Shard

STORED = {"relight": 0.2, "reinsert": 0.1, "shadow": 0.12}
"""How often objects are drawn whose damage is stored: relit and re-inserted ones; and placed ones, right as they are."""
RENDERED_ONES = 0.25  # how often a picture is a rendering and no photo, as where the enhancer is used
ANY_REGION = 0.15  # how often the object is any region of a picture
WHOLE = 0.12  # how often it is the whole picture, which only right pictures tell the colours of
COARSE = 4  # how much smaller than the picture that region is drawn
VARIANTS = 3  # how often an object is used, each time in other colours
RIGHT = 0.35  # how often an object is right as it is


class ObjectSampler:
    """Draws objects of the training clips by kind, and of further photos; `alters` them, or draws those alone whose damage is stored."""

    def __init__(self, shards: dict[str, list[Shard]], photos: list[np.ndarray], alters: bool = True):
        self.shards, self.photos, self.alters = shards, photos, alters
        self.places = {kind: [s for s in shards.get(kind, ()) if s.meta.get("instances")] for kind in STORED}
        self.plain = [s for kind in ("clean", "isp") for s in shards.get(kind, ())]
        self.rendered = [s for kind in RENDERED for s in shards.get(kind, ())]

    def draw(self, rng: np.random.Generator, count: int, progress: Callable[[int], None] | None = None) -> Objects:
        """`count` objects; `progress` is called with how many there are, after each picture."""
        drawn: list[tuple] = []
        while len(drawn) < count:
            drawn += self._object(rng)
            if progress is not None:
                progress(min(len(drawn), count))
        e, *pixels = zip(*drawn[:count], strict=True)
        return Objects(Evidence.stacked(list(e)), *(torch.stack(p) for p in pixels))

    def _object(self, rng: np.random.Generator) -> list[tuple]:
        """An object, VARIANTS times; nothing where the picture drawn has none."""
        kind = rng.choice([*STORED, ""], p=[*STORED.values(), 1 - sum(STORED.values())])
        if self.places.get(kind):
            shard = self.places[kind][rng.integers(len(self.places[kind]))]
            t = int(rng.integers(shard.frames))
            wanted, instance = shard.frame("target", t)
            given = wanted if kind == "shadow" else shard.frame("input", t)[0]
            some = shard.meta["instances"] if rng.random() < 0.7 else None
            fresh = kind == "shadow"
        else:
            given, instance = self._picture(rng)
            if rng.random() < WHOLE:
                instance = torch.ones_like(instance)
            wanted, some, fresh = given, None, True
        found = boxes(torch.where(instance == 255, 0, instance.int()))
        ids = [i for i in found if some is None or i in some]
        if not ids:
            return []
        areas = np.bincount(instance.numpy().ravel(), minlength=256)[ids] ** 0.5
        pick = ids[rng.choice(len(ids), p=areas / areas.sum())]
        return self._altered(rng, given, wanted, instance, pick, found[pick], fresh)

    def _picture(self, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """A right picture and its objects, or a region of it as if it were one."""
        region = rng.random() < ANY_REGION
        if self.plain and (not self.photos or not region or rng.random() < 0.5):
            render = bool(self.rendered) and rng.random() < RENDERED_ONES
            stored = self.rendered if render else self.plain
            shard = stored[rng.integers(len(stored))]
            rgb, instance = shard.frame("input" if render else "target", int(rng.integers(shard.frames)))
        else:
            rgb = torch.from_numpy(self.photos[rng.integers(len(self.photos))])
            instance = torch.zeros(rgb.shape[:2], dtype=torch.uint8)
        if region or not self.plain:
            mask = torch.from_numpy(random_mask(rng, instance.shape[0] // COARSE, instance.shape[1] // COARSE))
            instance = (F.interpolate(mask[None, None], instance.shape, mode="bilinear")[0, 0] > 0.5).to(torch.uint8)
        return rgb, instance

    def _altered(
        self,
        rng: np.random.Generator,
        given: torch.Tensor,
        wanted: torch.Tensor,
        instance: torch.Tensor,
        pick: int,
        box: Box,
        fresh: bool,
    ) -> list[tuple]:
        ids = instance[box.outer_rows, box.outer_columns].int()
        mask, seen_as = ids == pick, reaching_over(torch.where(ids == 255, 0, ids))
        at = spots(Outlines([Outline.of(seen_as, pick, box.alone())]), instance.numel())
        judged = mask.nonzero()[torch.from_numpy(rng.integers(int(mask.sum()), size=PIXELS))]
        y, x = torch.cat([at.yx[0], judged]).unbind(1)
        strips = [p[y + box.outer_rows.start, x + box.outer_columns.start].T[:, None].float() / 255 for p in (given, wanted)]
        thin = given[:: max(1, given.shape[0] // 45), :: max(1, given.shape[1] // 80)].permute(2, 0, 1)
        grid = grid_of(thin).float() / 255
        soft = F.avg_pool2d(mask[None].float(), 3, 1, 1)[0] if rng.random() < 0.7 else mask.float()
        others = ((ids > 0) & (ids < 255) & ~mask)[y, x][None, None].float()
        height = box.placed(judged[:, 0] + box.outer_rows.start, judged[:, 1] + box.outer_columns.start)[:, 0]
        drawn = []
        for _ in range(VARIANTS):
            (seen, target), whole = strips, grid
            if rng.random() < 0.65 and not mask.all():  # the whole picture in another light: what counts is the difference within it
                grade = random_isp(rng, 0.7)
                seen, target, whole = grade(seen), grade(target), grade(whole)
            if fresh and self.alters and rng.random() > RIGHT:
                isp = random_isp(rng)
                seen = alter(seen, soft[y, x][None, None], isp)
                if others.any() and rng.random() < 0.4:
                    seen = alter(seen, others, isp if rng.random() < 0.5 else random_isp(rng))
            seen, target = seen[:, 0].T, target[:, 0].T
            seen = ((seen * 255).round() + torch.from_numpy(rng.random(seen.shape, dtype=np.float32)) - 0.5) / 255
            read = evidence(seen[None, :-PIXELS], at, whole_of(whole))
            drawn.append((_mirrored(read) if rng.random() < 0.5 else read, seen[-PIXELS:], target[-PIXELS:], height))
        return drawn


def _mirrored(e: Evidence) -> Evidence:
    """Left and right changed."""
    place, inside, around, whole = (v.clone() for v in (e.place, e.inside, e.around, e.whole))
    place[..., [1, 3]] *= -1
    for v in (inside, around, whole):
        v[..., 4] *= -1
    return Evidence(e.seam, place, e.known, inside, around, whole)
