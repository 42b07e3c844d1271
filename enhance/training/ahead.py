"""Samples for a GPU, which trains on them faster than one core draws them: other processes draw what the next steps take."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any, TypeVar

import torch
from torch.utils.data import DataLoader, Dataset

from enhance.batch import Batch

T = TypeVar("T", bound=Batch)
DEEP = 2
"""Batches that each process may be ahead."""


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
        multiprocessing_context="fork",  # what is drawn from need not be copied
        generator=torch.Generator(),  # its own, so that the loader draws nothing from the training's
    )
    yield from loader  # whose processes begin with the first batch that is asked for, and end with this generator
