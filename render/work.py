"""What projection is told to go through: groups of splats whose tensors lie side by side, cut into items.

A launch costs tens of microseconds and a drive has dozens of actors, so small instances are put together into one group. An item is a run
of ITEM splats of one instance; those that nobody can see have none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from render.kernels.types import FIRST, ITEM
from render.launch import stream_of, upload

SMALL = 8192
"""Splats below which an instance is put together with others: its copy then costs less than a launch."""

Fields = tuple[torch.Tensor, ...]


@dataclass(frozen=True)
class Group:
    """Splats that one launch projects. fields: of `Gaussians`; members: which instances they are, in order; sizes: splats of each;
    items int32 `[n, 4]` (FIRST, COUNT, BASE, DRAW of `kernels.types`), by instance; per_member: items of each."""

    fields: Fields
    members: list[int]
    sizes: list[int]
    items: torch.Tensor
    per_member: list[int]


@dataclass(frozen=True)
class Work:
    """All groups, and how many splats they project together."""

    groups: list[Group]
    records: int


def work(instances: Sequence[Fields], seen: Sequence[np.ndarray | None] | None = None, copies: int = 1) -> Work:
    """The work of projecting all instances, `copies` times; records are numbered by copy, instance and splat.

    seen: bool `[items]` of each instance, which of its runs of ITEM splats are projected; None for all.
    """
    sizes, device = tuple(len(fields[0]) for fields in instances), instances[0][0].device
    together = tuple(tuple(members) for members in _together(instances))
    if seen is None or all(s is None or s.all() for s in seen):
        items, per_instance, records = _all_items(sizes, together, copies, device, stream_of(device))
    else:
        items, per_instance, records = _items(sizes, together, copies, device, seen)
    groups = []
    for i, members in enumerate(together):
        fields = instances[members[0]]
        if len(members) > 1:
            fields = tuple(torch.cat([instances[p][k] for p in members]) for k in range(len(fields)))
        lengths, cuts = [sizes[p] for p in members], [per_instance[p] for p in members]
        groups += [Group(fields, list(members), lengths, own, cuts) for own in items[i]]
    return Work(groups, records)


Items = tuple[list[list[torch.Tensor]], list[int], int]
"""Of each group, each copy's items; how many each instance has; and how many splats all have."""


@lru_cache(maxsize=16)
def _all_items(sizes: tuple[int, ...], together: tuple[tuple[int, ...], ...], copies: int, device: torch.device, _stream: int) -> Items:
    """Kept: nobody writes to them."""
    return _items(sizes, together, copies, device, None)


def _items(sizes: Sequence[int], together, copies: int, device: torch.device, seen: Sequence[np.ndarray | None] | None) -> Items:
    per_instance = [-(-n // ITEM) for n in sizes]
    owner = np.repeat(np.arange(len(sizes)), per_instance)
    first = (np.arange(len(owner)) - (np.cumsum(per_instance) - per_instance)[owner]) * ITEM
    if seen is not None:
        kept = np.concatenate([np.ones(n, dtype=bool) if s is None else s for s, n in zip(seen, per_instance, strict=True)])
        owner, first = owner[kept], first[kept]
        per_instance = np.bincount(owner, minlength=len(sizes)).tolist()
    count = np.minimum(np.asarray(sizes)[owner] - first, ITEM)
    items = np.stack([first, count, count.cumsum() - count, owner], 1).astype(np.int32)
    of_instance, projected = np.split(items, np.cumsum(per_instance)[:-1]), int(count.sum())
    made = []
    for members in together:
        own = np.concatenate([of_instance[p] for p in members])
        lengths = [sizes[p] for p in members]
        own[:, FIRST] += np.repeat(np.cumsum(lengths) - lengths, [per_instance[p] for p in members])
        steps = [np.array([0, 0, copy * projected, copy * len(sizes)], dtype=np.int32) for copy in range(copies)]
        made.append([upload(torch.from_numpy(own + step), device) for step in steps])
    return made, per_instance, copies * projected


def _together(instances: Sequence[Fields]) -> Iterator[list[int]]:
    """The instances of each group: large ones alone, small ones with all that have as many harmonics."""
    small: dict[int, list[int]] = {}
    for p, fields in enumerate(instances):
        if len(fields[0]) >= SMALL:
            yield [p]
        else:
            small.setdefault(fields[-1].shape[1], []).append(p)
    yield from small.values()
