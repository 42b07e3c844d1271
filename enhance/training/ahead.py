"""Samples for a GPU, which trains on them faster than one core draws them: other processes draw what the next steps take."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from itertools import count
from typing import Any, TypeVar

import torch
from torch.utils.data import DataLoader, Dataset

T = TypeVar("T", bound="Batch")
DEEP = 2
"""Batches that each process may be ahead."""


class Batch:
    """A frozen dataclass of tensors and other batches, that goes to a device as one."""

    def each(self: T, change: Callable[[Any], Any]) -> T:
        """With every tensor changed."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]  # the subclasses are dataclasses
        return replace(self, **{k: v.each(change) if isinstance(v, Batch) else change(v) for k, v in values.items()})  # type: ignore[type-var]

    def pin_memory(self: T) -> T:
        """Under the name that torch's loader asks for: from pinned memory a copy to the GPU does not wait for it."""
        return self.each(torch.Tensor.pin_memory)

    def to(self: T, device: torch.device) -> T:
        return self.each(lambda x: x.to(device, non_blocking=True))


def workers(device: torch.device) -> int:
    """How many processes draw for training on `device`: none for the CPU, which has better to do, and for a GPU all cores but one."""
    return 0 if device.type == "cpu" else max(1, len(os.sched_getaffinity(0)) - 1)


def drawn(draw: Callable[[int], T | None], begin: int, device: torch.device, processes: int) -> Iterator[T | None]:
    """`draw(begin)`, `draw(begin + 1)` and so on without end, on the device. What is drawn must depend on that number alone; then it is the
    same for any number of processes. With 0 each is drawn when it is asked for."""
    drawing = map(draw, count(begin)) if processes == 0 else _loaded(draw, begin, device, processes)
    return (batch if batch is None else batch.to(device) for batch in drawing)


class _Draws(Dataset):
    def __init__(self, draw: Callable[[int], Any]):
        self.draw = draw

    def __getitem__(self, step: int) -> Any:
        return self.draw(step)


def _loaded(draw: Callable[[int], Any], begin: int, device: torch.device, processes: int) -> Iterator[Any]:
    loader = DataLoader(
        _Draws(draw),
        batch_size=None,
        sampler=count(begin),
        num_workers=processes,
        prefetch_factor=DEEP,
        pin_memory=device.type == "cuda",
        multiprocessing_context="fork",  # what is drawn from, photos in memory too, need not be copied
        generator=torch.Generator(),  # its own, so that the loader draws nothing from the training's
    )
    yield from loader  # whose processes begin with the first batch that is asked for, and end with this generator
