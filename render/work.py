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

from render.kernels.types import BASE, COUNT, DRAW, FIRST, ITEM
from render.launch import upload

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
    sizes = [len(fields[0]) for fields in instances]
    items, per_instance = _cut(tuple(sizes))
    if seen is not None and not all(s is None or s.all() for s in seen):
        kept = np.concatenate([np.ones(n, dtype=bool) if s is None else s for s, n in zip(seen, per_instance, strict=True)])
        items = items[kept]
        items[:, BASE] = items[:, COUNT].cumsum() - items[:, COUNT]
        per_instance = np.bincount(items[:, DRAW], minlength=len(instances)).tolist()
    projected = int(items[-1, BASE] + items[-1, COUNT]) if len(items) else 0
    ends = np.cumsum(per_instance).tolist()

    groups = []
    for members in _together(instances):
        fields, own = instances[members[0]], items[ends[members[0]] - per_instance[members[0]] : ends[members[0]]]
        lengths, cuts = [sizes[p] for p in members], [per_instance[p] for p in members]
        if len(members) > 1:
            fields = tuple(torch.cat([instances[p][k] for p in members]) for k in range(len(fields)))
            own = np.concatenate([items[ends[p] - per_instance[p] : ends[p]] for p in members])
            own[:, FIRST] += np.repeat(np.cumsum(lengths) - lengths, cuts)
        for copy in range(copies):
            there = own + np.array([0, 0, copy * projected, copy * len(instances)], dtype=np.int32)
            groups.append(Group(fields, members, lengths, upload(torch.from_numpy(there), fields[0].device), cuts))
    return Work(groups, copies * projected)


@lru_cache(maxsize=16)
def _cut(sizes: tuple[int, ...]) -> tuple[np.ndarray, list[int]]:
    """Items int32 `[n, 4]` of all splats of instances of these sizes, and how many each instance has; kept, so nobody may write to them."""
    per_instance = [-(-n // ITEM) for n in sizes]
    owner = np.repeat(np.arange(len(sizes)), per_instance)
    first = (np.arange(len(owner)) - (np.cumsum(per_instance) - per_instance)[owner]) * ITEM
    count = np.minimum(np.asarray(sizes)[owner] - first, ITEM)
    items = np.stack([first, count, count.cumsum() - count, owner], 1).astype(np.int32)
    items.flags.writeable = False
    return items, per_instance


def _together(instances: Sequence[Fields]) -> Iterator[list[int]]:
    """The instances of each group: large ones alone, small ones with all that have as many harmonics."""
    small: dict[int, list[int]] = {}
    for p, fields in enumerate(instances):
        if len(fields[0]) >= SMALL:
            yield [p]
        else:
            small.setdefault(fields[-1].shape[1], []).append(p)
    yield from small.values()
