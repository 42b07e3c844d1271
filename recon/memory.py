"""Whether a drive's lidar has room in memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from recon.log import Log, Sweep

A_POINT = 200
"""Bytes that a point takes while a fit is prepared, by three cameras of drive 002: its place, colours in each camera, and cells."""

INFO = Path("/proc/meminfo")


def check_memory(log: Log, sweeps: Sequence[Sweep]) -> None:
    """ValueError with the fix where the points of all of a log's `sweeps`, each of as many as the middle one, which is read, have no room.

    Otherwise the system would end the process, or swap for hours. Where nobody tells what is free, there is taken to be room.
    """
    free = _free()
    if free is None or not sweeps:
        return
    wanted = A_POINT * len(sweeps) * len(sweeps[len(sweeps) // 2].read().xyz)
    if wanted > free:
        fits = (sweeps[-1].time_us - sweeps[0].time_us) * free / wanted / 1e6
        much = (
            f"{len(sweeps)} lidar sweeps of {log.path} take about {wanted / 2**30:.3g} GiB of memory, and {free / 2**30:.3g} GiB are free"
        )
        raise ValueError(f"{much}; reconstruct a part with --duration {max(1, int(fits))}s, and others with --start")


def _free() -> int | None:
    """Bytes of memory that are free, where Linux tells them."""
    try:
        told = dict(line.split(":", 1) for line in INFO.read_text().splitlines() if ":" in line)
        return 1024 * int(told["MemAvailable"].split()[0])
    except (OSError, LookupError, ValueError):
        return None
