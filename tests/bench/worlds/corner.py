"""The street's junction, where the car turns left into the side street, between houses there."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from render.tracer import Mesh
from tests.bench.worlds.people import walker
from tests.bench.worlds.place import Place, along, clock
from tests.bench.worlds.solids import box, facade, grain, joined
from tests.bench.worlds.street import (
    FRAMES,
    HALF,
    JUNCTION,
    KERB,
    LIDAR,
    LIGHT,
    STEP_US,
    car,
    furniture,
    ground,
    houses,
    models_in,
    parked,
    plaster,
    rig,
)

SPEED, RADIUS = 5.5, 9.0
"""Metres a second, and of the turn."""


def corner(meshes: Path, seed: int = 1) -> Place:
    """meshes: the folder with the cars' and the street furniture's GLB files."""
    chance = np.random.default_rng(seed)
    models = models_in(meshes)
    times = clock(FRAMES + 1, STEP_US)
    lane = JUNCTION[1] - 2.6
    turns = np.linspace(0, math.pi / 2, 30)
    arc = [(lane - RADIUS * (1 - math.sin(a)), -2.2 + RADIUS * (1 - math.cos(a))) for a in turns]
    return Place(
        "corner",
        joined([*ground(seed), *houses(chance), *_side_street(chance), *furniture(chance, models), *parked(chance, models)]),
        (
            car("ahead", models["prius_hybrid"], [(56.0, -2.2), (130.0, -2.2)], 7.0, times),
            car("coming", models["hatchback_red"], [(90.0, 2.6), (-40.0, 2.6)], 8.0, times),
            car("waits", models["pickup"], [(JUNCTION[0] + 2.4, 34.0), (JUNCTION[0] + 2.4, 9.0)], 2.5, times),
            walker("crosses", [(58.0, -8.0), (58.0, 8.0)], 1.4, times, 20),
            walker("along", [(JUNCTION[1] + 1.5, 14.0), (JUNCTION[1] + 1.5, 40.0)], 1.3, times, 30),
        ),
        LIGHT,
        along([(40.0, -2.2), *arc, (lane, 60.0)], SPEED, times),
        rig(times),
        LIDAR,
        ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0), (-1.0, 0.0), (-2.0, 0.0)),
    )


def _side_street(chance: np.random.Generator) -> list[Mesh]:
    """Pavements and houses to both sides of the street that the car turns into, and one that closes it."""
    out, flags, roof = [], grain(3, (0.6, 0.57, 0.53)), grain(77, (0.4, 0.25, 0.2), 0.2)
    for x, side in ((JUNCTION[0], -1), (JUNCTION[1], 1)):
        out.append(box((x + side * 2.0, (HALF + 4 + 70) / 2, 0), (4.0, 66.0 - HALF, KERB), flags, 3.0))
        y = HALF + 17.0
        while y < 66.0:
            width, height = 3.0 * chance.integers(3, 6), 3.0 * chance.integers(2, 5)
            wall = plaster(chance)
            out.append(box((x + side * (4 + chance.uniform(0, 1.5) + 5), y + width / 2, 0), (10.0, width, height), wall, 3.0, roof))
            y += width + chance.choice([0.0, 0.0, 1.5])
    return [*out, box(((JUNCTION[0] + JUNCTION[1]) / 2, 80.0, 0), (40, 10, 12), facade(6, (0.62, 0.55, 0.42)), 3.0, roof)]
