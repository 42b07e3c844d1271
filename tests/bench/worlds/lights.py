"""The street's junction again: the car brakes before it, stands while others cross, and goes on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.bench.worlds.people import walker
from tests.bench.worlds.place import Place, clock, gone
from tests.bench.worlds.street import FRAMES, HALF, JUNCTION, STEP_US, car, models_in, rig, street

SPEED, BRAKES, STANDS = 7.0, 2.6, (2.4, 5.2)
"""Metres a second; m/s^2 at which it brakes and goes on; and seconds from and to which it stands."""

BEFORE = 8.5
"""Metres before the junction at which it stands."""


def lights(meshes: Path, seed: int = 0) -> Place:
    """meshes: the folder with the cars' and the street furniture's GLB files."""
    times, models = clock(FRAMES + 1, STEP_US), models_in(meshes)
    seconds = (times - times[0]).numpy() / 1e6
    pace = np.clip(BRAKES * np.maximum(STANDS[0] - seconds, seconds - STANDS[1]), 0, SPEED)
    went = np.concatenate([[0], np.cumsum((pace[1:] + pace[:-1]) / 2 * np.diff(seconds))])
    stop = JUNCTION[0] - BEFORE
    way = [(stop - float(np.interp(STANDS[0], seconds, went)), -2.2), (160.0, -2.2)]
    return replace(
        street(meshes, seed),
        name="lights",
        movers=(
            car("ahead", models["prius_hybrid"], [(56.0, -2.2), (190.0, -2.2)], 9.0, times),
            car("from the right", models["hatchback_blue"], [(JUNCTION[0] + 7.5, -32.0), (JUNCTION[0] + 7.5, 60.0)], 9.0, times),
            car("from the left", models["pickup"], [(JUNCTION[0] + 2.5, 48.0), (JUNCTION[0] + 2.5, -60.0)], 10.0, times),
            car("coming", models["hatchback_red"], [(124.0, 2.6), (-40.0, 2.6)], 8.0, times),
            walker("crosses", [(JUNCTION[0] - 2.2, -HALF - 2.5), (JUNCTION[0] - 2.2, 9.0)], 1.4, times, 20),
            walker("along", [(stop - 14.0, 7.4), (stop + 9.0, 7.4)], 1.3, times, 40),
        ),
        ego=gone(way, went, times),
        rig=rig(times),
    )
