"""The made-up recording in the layout of the Waymo Open Dataset, version 2."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from made_tape import BODY_FROM_LIDAR, STAMPS, STEP_US, Tape

from tests.layouts.waymo import SEGMENT, write

__all__ = ["NAMES", "READOUT_US", "SEGMENT", "near_points", "write_waymo"]

NAMES = {"front": "front", "right": "front_right"}
READOUT_US = 24_000
SHUTTERS = {"front": ("rows", READOUT_US), "right": ("columns", -READOUT_US)}
BEAMS = np.linspace(-1.2, 0.4, 150)
COLUMNS = 1800


def near_points(tape: Tape) -> np.ndarray:
    """The static points within 25 m of the lidar at all times."""
    away = np.linalg.norm(np.stack([tape.scan(int(t)) for t in STAMPS[[0, -1]]]), axis=2).max(0)
    return tape.points[away < 25]


def write_waymo(folder: Path, tape: Tape) -> Path:
    """The folder of segments with one in it; the third sweep is lost."""
    log = tape.log({"front": 10_000, "right": 30_000}, turn_us=STEP_US, encoded="JPEG")
    cameras = {name: replace(c, shutter=SHUTTERS[name][0], readout_us=SHUTTERS[name][1]) for name, c in log.cameras.items()}
    write(folder, replace(log, cameras=cameras), BODY_FROM_LIDAR, BEAMS, COLUMNS)
    return folder
