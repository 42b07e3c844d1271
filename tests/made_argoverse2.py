"""The made-up recording in the layout of Argoverse 2's sensor data set."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from made_tape import STEP_US, Tape

from recon.log import LidarPoints, Sweep
from tests.layouts.argoverse2 import NAMES, write

__all__ = ["NAMES", "write_argoverse2"]


def write_argoverse2(folder: Path, tape: Tape) -> Path:
    """One log; the third sweep is lost. Points come one after the other within a step, from one lidar and the other by turns of 32."""
    log = tape.log({"front": 10_000, "right": 20_000}, encoded="JPEG")

    def by_turns(sweep: Sweep) -> Sweep:
        xyz = sweep.read().xyz
        times = sweep.time_us + np.linspace(0, STEP_US, len(xyz)).astype(np.int64)
        points = LidarPoints(xyz, times, np.arange(len(xyz)) % 64 // 32)
        return replace(sweep, read=lambda: points)

    return write(folder, replace(log, sweeps=tuple(map(by_turns, log.sweeps))))
