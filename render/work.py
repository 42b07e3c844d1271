"""What projection is told to go through: groups of splats whose tensors lie side by side, cut into items.

A launch costs tens of microseconds and a drive has dozens of actors, so small instances are put together into one group. An item is a run
of ITEM splats of one instance; those that nobody can see have none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from render.kernels.types import ITEM
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


def work(instances: Sequence[Fields], seen: Sequence[torch.Tensor | None] | None = None, copies: int = 1) -> Work:
    """The work of projecting all instances, `copies` times; records are numbered by copy, instance and splat.

    seen: bool `[items]` of each instance, which of its runs of ITEM splats are projected; None for all.
    """
    device = instances[0][0].device
    sizes = torch.tensor([len(fields[0]) for fields in instances])
    cut = -(-sizes // ITEM)
    owner = torch.repeat_interleave(cut)
    first = (torch.arange(len(owner)) - (cut.cumsum(0) - cut)[owner]) * ITEM
    if seen is not None:
        kept = torch.cat([torch.ones(n, dtype=torch.bool) if s is None else s for s, n in zip(seen, cut.tolist(), strict=True)])
        owner, first = owner[kept], first[kept]
    count = (sizes[owner] - first).clamp(max=ITEM)
    base = count.cumsum(0) - count
    per_instance = torch.bincount(owner, minlength=len(instances)).tolist()
    projected = int(count.sum())
    items = torch.stack([first, count, base, owner], 1).to(torch.int32)
    of_instance = items.split(per_instance)

    groups = []
    for members in _together(instances):
        lengths = [len(instances[p][0]) for p in members]
        fields = instances[members[0]]
        own = of_instance[members[0]]
        if len(members) > 1:
            fields = tuple(torch.cat([instances[p][k] for p in members]) for k in range(len(fields)))
            before = torch.tensor([sum(lengths[:k]) for k in range(len(members))], dtype=torch.int32)
            counts = [per_instance[p] for p in members]
            own = torch.cat([of_instance[p] for p in members])
            own[:, 0] += before.repeat_interleave(torch.tensor(counts))
        for copy in range(copies):
            there = own + torch.tensor([0, 0, copy * projected, copy * len(instances)], dtype=torch.int32)
            groups.append(Group(fields, members, lengths, upload(there, device), [per_instance[p] for p in members]))
    return Work(groups, copies * projected)


def _together(instances: Sequence[Fields]) -> Iterator[list[int]]:
    """The instances of each group: large ones alone, small ones with all that have as many harmonics."""
    small: dict[int, list[int]] = {}
    for p, fields in enumerate(instances):
        if len(fields[0]) >= SMALL:
            yield [p]
        else:
            small.setdefault(fields[-1].shape[1], []).append(p)
    yield from small.values()
