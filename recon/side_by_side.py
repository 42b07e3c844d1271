"""Independent pieces of work on all cores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")


def side_by_side(work: Callable[[T], R], jobs: Iterable[T]) -> Iterator[R]:
    """What `work` makes of each of `jobs`, in their order: as many at once as torch has threads, and one of these for each. Work of many
    small operations is done sooner so than with all threads on one operation after the other."""
    threads = torch.get_num_threads()
    with ThreadPoolExecutor(threads, initializer=partial(torch.set_num_threads, 1)) as pool:
        try:
            yield from pool.map(work, jobs)
        finally:
            pool.shutdown(cancel_futures=True)  # on Ctrl-C what was not begun is not
            torch.set_num_threads(threads)  # torch takes the last number that any thread set for the next new thread's
