"""What the benchmarks measure with: median milliseconds, peak memory, the machine's rate of fused multiply-adds."""

from __future__ import annotations

import ctypes
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
import warp as wp

import render.launch  # noqa: F401 - starts Warp quietly
from render.kernels.types import OPTIONS, TILE, lanes

CHAINS = 8


CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}
"""cpu: the time of all threads together, for machines that others use as well."""


def timed(work: Callable[[], object], repeat: int, clock: str = "wall") -> float:
    """Median milliseconds of `work()` after one warm-up, until a GPU, where there is one, has done it."""
    _finished(work())
    times = []
    for _ in range(repeat):
        start = CLOCKS[clock]()
        _finished(work())
        times.append(1000 * (CLOCKS[clock]() - start))
    return statistics.median(times)


def _finished(_made: object) -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def in_turns(works: dict[str, Callable[[], object]], repeat: int, clock: str = "wall", rounds: int = 3) -> dict[str, float]:
    """Median milliseconds of each, in rounds that alternate, so that a change of the machine's speed meets all alike."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            times[name].append(timed(work, max(1, repeat // rounds), clock))
    return {name: statistics.median(values) for name, values in times.items()}


def peak_memory(work: Callable[[], object]) -> int:
    """Bytes that `work()` takes at most beyond what is held before it; its kernels must be loaded. 0 where Linux does not say."""
    try:
        if sys.platform == "linux":
            ctypes.CDLL(None).malloc_trim(0)  # what malloc keeps for later is not in use
        Path("/proc/self/clear_refs").write_text("5")  # the high-water mark starts anew
        before = _status("VmRSS")
        work()
        return max(0, _status("VmHWM") - before)
    except OSError:
        work()
        return 0


def _status(name: str) -> int:
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith(name + ":"))
    return 1024 * int(line.split()[1])


@wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
def multiply_add(values: wp.array[lanes], count: int):
    """Eight independent chains of lane multiply-adds: as fast as this machine's units go."""
    a = values[0]
    b = values[1]
    c0 = values[2]
    c1 = values[3]
    c2 = values[4]
    c3 = values[5]
    c4 = values[6]
    c5 = values[7]
    c6 = values[8]
    c7 = values[9]
    for _i in range(count):
        c0 = wp.cw_mul(c0, a) + b
        c1 = wp.cw_mul(c1, a) + b
        c2 = wp.cw_mul(c2, a) + b
        c3 = wp.cw_mul(c3, a) + b
        c4 = wp.cw_mul(c4, a) + b
        c5 = wp.cw_mul(c5, a) + b
        c6 = wp.cw_mul(c6, a) + b
        c7 = wp.cw_mul(c7, a) + b
    values[2] = c0 + c1 + c2 + c3 + c4 + c5 + c6 + c7


def lane_rate(threads: int, count: int = 4_000_000) -> float:
    """Lane operations (16 multiply-adds each) a second of `threads` cores: one's, by its own clock, which other processes do not touch."""
    values = wp.array(torch.full((10, TILE), 0.5).numpy(), dtype=lanes, device="cpu")
    seconds = []
    for _ in range(6):
        start = time.thread_time()
        wp.launch(multiply_add, dim=1, inputs=[values, count], device="cpu")
        seconds.append(time.thread_time() - start)
    return threads * count * CHAINS / min(seconds[1:])
