"""The made-up recording in nuScenes' layout."""

import shutil
from dataclasses import replace
from pathlib import Path

from made_tape import BODY_FROM_LIDAR, LOST, Tape

from tests.layouts.nuscenes import NAMES, write

__all__ = ["NAMES", "write_nuscenes"]


def write_nuscenes(folder: Path, tape: Tape) -> Path:
    """The data set's folder with scene-0061; the third sweep is no key frame and lost, as where sweeps/ was not fetched."""
    log = tape.log({"front": 10_000, "right": 20_000}, lost=None)
    sweeps = tuple(replace(s, time_us=s.time_us + 25_000) if s.index == LOST else s for s in log.sweeps)
    write(folder, replace(log, sweeps=sweeps), BODY_FROM_LIDAR)
    shutil.rmtree(folder / "sweeps")
    return folder
