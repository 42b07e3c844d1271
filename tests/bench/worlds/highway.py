"""A motorway: three lanes each way, a concrete barrier, guard rails, a noise wall, gantries, trees, and traffic as fast as the car."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from render.tracer import Mesh
from tests.bench.worlds.place import Light, Place, along, clock
from tests.bench.worlds.solids import box, crown, grain, joined, painted, panel, plain
from tests.bench.worlds.street import FRAMES, LIDAR, STEP_US, car, models_in, rig

SPEED = 24.7
LANE, LOW, HIGH = 3.7, -60.0, 420.0
"""Metres: a lane's width, and where the road begins and ends."""

EDGE = 3 * LANE + 1.0
"""Metres from the middle to the outer edge lines."""


def highway(meshes: Path, seed: int = 2) -> Place:
    """meshes: the folder with the cars' GLB files."""
    chance = np.random.default_rng(seed)
    models = models_in(meshes)
    times = clock(FRAMES + 1, STEP_US)
    lanes = [-(1.0 + LANE * (k + 0.5)) for k in range(3)]
    return Place(
        "highway",
        joined([*_road(seed), *_beside(chance)]),
        (
            car("ahead", models["prius_hybrid"], [(26.0, lanes[1]), (900.0, lanes[1])], 25.7, times),
            car("overtakes", models["hatchback_blue"], [(-14.0, lanes[0]), (900.0, lanes[0])], 29.6, times),
            car("overtaken", models["pickup"], [(34.0, lanes[2]), (900.0, lanes[2])], 20.8, times),
            car("coming", models["hatchback_red"], [(230.0, -lanes[1]), (-900.0, -lanes[1])], 26.0, times),
            car("second", models["hatchback"], [(330.0, -lanes[2]), (-900.0, -lanes[2])], 24.0, times),
        ),
        Light((-0.5, -0.35, 0.79), (1.0, 0.95, 0.86), (0.24, 0.28, 0.34), 25.0),
        along([(x, lanes[1] + 0.2 * math.sin(x / 60)) for x in np.arange(-2.0, 260.0, 2.0)], SPEED, times),
        rig(times),
        LIDAR,
        ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (LANE, 0.0), (-2.0, 0.0), (-LANE, 0.0)),
    )


def _road(seed: int) -> list[Mesh]:
    """Asphalt with edge lines, dashes of 3 m every 12, joints, and grass to both sides."""
    asphalt, white, grass = (
        grain(seed, (0.36, 0.36, 0.37), 0.1),
        grain(seed + 3, (0.85, 0.85, 0.82), 0.06),
        grain(seed + 4, (0.33, 0.4, 0.22), 0.4),
    )
    out = [panel((LOW, -EDGE - 3, 0), (HIGH - LOW, 0, 0), (0, 2 * EDGE + 6, 0), asphalt, 7.3)]
    out.append(panel((-900, -900, -0.1), (2400, 0, 0), (0, 1800, 0), grass, 12.0))
    for side in (-1, 1):
        for y in (1.0, EDGE):
            out.append(panel((LOW, side * y - 0.07, 0.003), (HIGH - LOW, 0, 0), (0, 0.14, 0), white, 1.0))
        for k in (1, 2):
            for x in np.arange(LOW, HIGH, 12.0):
                out.append(panel((x, side * (1.0 + k * LANE) - 0.07, 0.003), (3.0, 0, 0), (0, 0.14, 0), white, 1.0))
    tar = plain((0.16, 0.16, 0.17))
    out += [panel((x, -EDGE - 3, 0.002), (0.12, 0, 0), (0, 2 * EDGE + 6, 0), tar) for x in np.arange(LOW, HIGH, 40.0)]
    return out


def _beside(chance: np.random.Generator) -> list[Mesh]:
    """The barrier in the middle, guard rails with posts, a wall behind the one to the left, gantries with signs, trees and bushes."""
    concrete, steel = grain(5, (0.62, 0.61, 0.58), 0.1), grain(6, (0.55, 0.57, 0.58), 0.06, 64)
    leaves, bark = grain(8, (0.2, 0.36, 0.13), 0.5, 128), grain(9, (0.35, 0.27, 0.2), 0.3, 64)
    out = [box(((LOW + HIGH) / 2, 0, 0), (HIGH - LOW, 0.5, 0.85), concrete, 4.0)]
    for side in (-1, 1):
        rail = side * (EDGE + 2.2)
        out.append(box(((LOW + HIGH) / 2, rail, 0.45), (HIGH - LOW, 0.08, 0.3), steel, 2.0))
        out += [box((x, rail + side * 0.1, -0.1), (0.1, 0.1, 0.8), steel) for x in np.arange(LOW, HIGH, 4.0)]
    out.append(box((170.0, EDGE + 5.0, -0.1), (180.0, 0.3, 4.0), grain(11, (0.5, 0.42, 0.33), 0.3), 3.0))
    for x in (70.0, 190.0):
        out.append(box((x, -EDGE - 3.5, -0.1), (0.4, 0.4, 7.0), steel))
        out.append(box((x, -EDGE / 2 - 1.5, 6.6), (0.4, EDGE + 4, 0.5), steel))
        out += [box((x - 0.3, -y, 5.2), (0.1, 3.2, 2.2), _sign(int(chance.integers(1 << 20))), None) for y in (3.5, 9.0)]
    for side, near, far in ((-1, EDGE + 6, EDGE + 40), (1, EDGE + 9, EDGE + 40)):
        for x in np.arange(LOW, HIGH + 100, 5.0):
            y, size = side * chance.uniform(near, far), chance.uniform(0.8, 1.8)
            at = x + chance.uniform(-2, 2)
            out.append(box((at, y, -0.1), (0.3, 0.3, 2.4 * size), bark, 1.0))
            out += crown(chance, (at, y, 3.2 * size), size, 4, (0.8, 1.3), leaves)
    return out


def _sign(seed: int, pixels: int = 128) -> np.ndarray:
    """White bars and an arrow on green, as a motorway's signs."""
    chance = np.random.default_rng(seed)
    picture = np.broadcast_to((0.05, 0.35, 0.2), (pixels, pixels, 3)).copy()
    for row in (0.2, 0.45):
        top, end = int(row * pixels), int(chance.uniform(0.5, 0.9) * pixels)
        for left in range(pixels // 10, end, pixels // 12):
            picture[top : top + pixels // 8, left : left + pixels // 18] = 0.92
    middle = pixels // 2
    for k in range(pixels // 5):
        picture[int(0.72 * pixels) + k, middle - k // 2 : middle + k // 2 + 1] = 0.92
    return painted(picture)
