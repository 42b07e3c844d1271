"""Where objects are in a frame, by a map of their ids: their boxes, their pixels, and their outlines, of which several are read at once.

A GPU's call takes it longer to begin than to do what is asked of one object, so all that is read of objects is read of all together.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np
import torch
from scipy import ndimage
from torch.nn import functional as F

from enhance.correcting.shade import DOWN

FEWEST = 64
"""Pixels that an object must have: what is smaller stays as it is."""
DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0))

A = TypeVar("A", torch.Tensor, np.ndarray)


@dataclass(frozen=True)
class Box:
    """An object's own rows and columns of a frame, and those with what is around it."""

    rows: slice
    columns: slice
    outer_rows: slice
    outer_columns: slice

    @classmethod
    def around(cls, rows: slice, columns: slice, height: int, width: int) -> Box:
        wide = max(8, (rows.stop - rows.start) // 2), max(8, (columns.stop - columns.start) // 2)
        grown = [slice(max(0, s.start - by), min(n, s.stop + by)) for s, by, n in zip((rows, columns), wide, (height, width), strict=True)]
        return cls(rows, columns, *grown)

    def alone(self) -> Box:
        """The same where the outer part is the whole frame."""
        by = self.outer_rows.start, self.outer_columns.start
        return Box(*(slice(s.start - d, s.stop - d) for part in self.parts() for s, d in zip(part, by, strict=True)))

    def parts(self) -> tuple[tuple[slice, slice], ...]:
        """Rows and columns of itself, and of the outer part."""
        return (self.rows, self.columns), (self.outer_rows, self.outer_columns)

    def places(self, where: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        """Of the N pixels that are True in bool `[h, w]` of the outer part: places `[N, 2]` down and across the box, -1..1 within it; and
        their rows and columns in the frame."""
        y, x = where.nonzero().unbind(1)
        y, x = y + self.outer_rows.start, x + self.outer_columns.start
        return self.placed(y, x), (y, x)

    def ground(self, ids: torch.Tensor) -> torch.Tensor:
        """Of a map of ids `[H, W]`, rows and columns of the outer part `[N, 2]` that are nobody's and low enough for `read_ground`."""
        lines = np.arange(self.outer_rows.start, self.outer_rows.stop)
        above = int((within(lines, self.rows.start, self.rows.stop) <= DOWN[0]).sum())
        found = (ids[self.outer_rows, self.outer_columns][above:] <= 0).nonzero()
        found[:, 0] += above
        return found

    def placed(self, y: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """Places `[N, 2]` in the box of rows and columns of the frame."""
        sides = ((y, self.rows), (x, self.columns))
        return torch.stack([within(at, side.start, side.stop) for at, side in sides], -1)


def within(at: A, start: A | int, stop: A | int) -> A:
    """Places of rows or columns in boxes, -1 where these begin and 1 where they end."""
    return (at + 0.5 - start) / (stop - start) * 2 - 1


def along(part: slice, side: slice, device: torch.device) -> torch.Tensor:
    """Places `[n]` of the pixels of `part` along a side of a box."""
    return within(torch.arange(part.start, part.stop, device=device), side.start, side.stop)


def boxes(instance: torch.Tensor) -> dict[int, Box]:
    """Of every object of FEWEST pixels and more in `[H, W]`, by its id above 0."""
    ids = instance.clamp_min(0).long().cpu().numpy()
    height, width = ids.shape
    names: Sequence[int] = range(int(ids.max()) + 1)
    if len(names) > ids.size:  # as colours that stand for objects: SciPy would make a list as long as the highest
        several, ids = np.unique(np.append(ids, 0), return_inverse=True)
        names, ids = several.tolist(), ids[:-1].reshape(height, width)
    found = {}
    for i, box in enumerate(ndimage.find_objects(ids), 1):
        if box is not None and int((ids[box] == i).sum()) >= FEWEST:
            found[names[i]] = Box.around(box[0], box[1], height, width)
    return found


@dataclass(frozen=True)
class Pixels:
    """Of several objects of a frame, one object's after the other's, N in all.

    at      `[N]`: where in the frame, row after row
    which   `[N]`: of which object, from 0
    height  `[N]`: in its box, -1 at the top and 1 at the base
    counts  how many are of each
    """

    at: torch.Tensor
    which: torch.Tensor
    height: torch.Tensor
    counts: tuple[int, ...]

    @classmethod
    def of(cls, ids: torch.Tensor, found: Mapping[int, Box], device: torch.device) -> Pixels:
        """Of the `found` objects of ids `[H, W]` on the CPU, where they are counted; the result is on `device`."""
        places: list[np.ndarray] = []
        counts: list[int] = []
        for i, box in found.items():
            y, x = np.nonzero(ids[box.rows, box.columns].numpy() == i)
            places.append(np.stack([(y + box.rows.start) * ids.shape[1] + x + box.columns.start, np.full_like(y, len(counts))]))
            counts.append(len(y))
        at, which = torch.from_numpy(np.concatenate(places, 1)).to(device)
        rows = torch.tensor([(box.rows.start, box.rows.stop) for box in found.values()], device=device)[which]
        return cls(at, which, within(at // ids.shape[1], *rows.unbind(1)), tuple(counts))


def reaching_over(ids: torch.Tensor) -> torch.Tensor:
    """Ids `[h, w]` where every object has also the pixels next to it that are nobody's (0 and less).

    So objects are looked at. At the last pixel that is mostly an object's, and the next, colours are still a mixture of both: what differs
    across the seam there is the object from its ground, which would be taken for a wrong light. A pixel on, it is the ground on both sides.
    """
    near = F.pad(ids.clamp_min(0), (1, 1, 1, 1))
    near = torch.maximum(torch.maximum(near[:-2], near[1:-1]), near[2:])
    near = torch.maximum(torch.maximum(near[:, :-2], near[:, 1:-1]), near[:, 2:])
    return torch.where((ids <= 0) & (near > 0), near, ids)


@dataclass(frozen=True)
class Outline:
    """An object in a map of ids.

    ids     `[H, W]`: the map, in which the object is `i`, in its box
    edges   `[E, 4]`: its pixels at its seam, rows and columns of the box's outer part, and the way out along rows or columns; where the
            picture ends is no seam
    own     `[A, 2]`: all its pixels there
    beside  `[B, 2]`: all others there; its own where there are none
    """

    ids: torch.Tensor
    i: int
    box: Box
    edges: torch.Tensor
    own: torch.Tensor
    beside: torch.Tensor

    @classmethod
    def of(cls, ids: torch.Tensor, i: int, box: Box) -> Outline:
        mask = ids[box.outer_rows, box.outer_columns] == i
        h, w = mask.shape
        free = ~F.pad(mask, (1, 1, 1, 1), value=True)
        next_to = torch.stack([free[1 + dy : 1 + dy + h, 1 + dx : 1 + dx + w] for dy, dx in DIRECTIONS])
        edges, own = (mask & next_to).nonzero(), mask.nonzero()
        beside = own if len(own) == mask.numel() else (~mask).nonzero()
        return cls(ids, i, box, torch.cat([edges[:, 1:], _directions(mask.device)[edges[:, 0]]], 1), own, beside)


@lru_cache(maxsize=4)
def _directions(device: torch.device) -> torch.Tensor:
    return torch.tensor(DIRECTIONS, device=device)


class Boxes:
    """Those of S objects, on a device.

    first, end  `[S, 2]`: rows and columns of the frame where their outer parts begin and end
    """

    def __init__(self, each: Iterable[Box], device: torch.device):
        lines = [[(side.start, side.stop) for part in box.parts() for side in part] for box in each]
        sides, outer = torch.tensor(lines, device=device).unflatten(1, (2, 2)).unbind(1)
        self.first, self.end = outer.unbind(2)
        self._sides = sides[:, None].unbind(3)

    def spread(self, rows: Sequence[torch.Tensor], count: int, repeated: bool = True) -> tuple[torch.Tensor, torch.Tensor]:
        """`count` of each object's rows, evenly spaced `[S, count, C]`, and which there are, bool `[S, count]`: where some have fewer,
        each comes once, unless `repeated`. Their first two columns are rows and columns of the outer parts, and become the frame's."""
        lengths = np.array([len(of) for of in rows])
        kept = np.full_like(lengths, count) if repeated else lengths.clip(1, count)
        k = np.arange(count)
        there = (k < kept[:, None]) & (lengths > 0)[:, None]
        at = ((k + 0.5) / kept[:, None] * lengths[:, None]).astype(np.int64) + (lengths.cumsum() - lengths)[:, None]
        nothing = rows[0].new_zeros(1, rows[0].shape[1])
        device = self.first.device
        found = torch.cat([*rows, nothing])[torch.from_numpy(np.where(there, at, lengths.sum())).to(device)]
        return found + F.pad(self.first, (0, found.shape[2] - 2))[:, None], torch.from_numpy(there).to(device)

    def places(self, yx: torch.Tensor) -> torch.Tensor:
        """Rows and columns of the frame `[S, N, 2]` as places in the boxes, -1..1 within."""
        return within(yx, *self._sides)


class Outlines(Boxes):
    """Those of S objects, in maps of one size."""

    def __init__(self, each: Sequence[Outline]):
        device = each[0].ids.device
        super().__init__([o.box for o in each], device)
        self.each = each
        maps = {id(o.ids): o.ids for o in each}
        self._maps = torch.stack(list(maps.values()))
        of = torch.tensor([[list(maps).index(id(o.ids)), o.i] for o in each], device=device)
        self._map, self._i = (x[:, None, None] for x in of.unbind(1))

    def seam(self, count: int) -> tuple[torch.Tensor, torch.Tensor]:
        """At most `count` of each object's edges, `[S, count, 4]`, and which there are."""
        return self.spread([o.edges for o in self.each], count, repeated=False)

    def ids(self, y: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """In the objects' maps at rows and columns `[S, N, M]`."""
        return self._maps[self._map, y, x]

    def mine(self, ids: torch.Tensor) -> torch.Tensor:
        """Which ids `[S, N, M]` are the objects' own."""
        return ids == self._i
