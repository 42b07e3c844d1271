"""A street that dips under a railway between retaining walls: slopes, a ceiling, darkness, and a camera that exposes by what it sees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from render.tracer import Mesh
from scenes.trajectory import Trajectory
from tests.bench.worlds.people import walker
from tests.bench.worlds.place import Light, Place, along, clock
from tests.bench.worlds.slopes import level, over, strip
from tests.bench.worlds.solids import box, crown, facade, grain, joined, painted, panel, plain
from tests.bench.worlds.street import FRAMES, LIDAR, STEP_US, car, models_in, plaster, rig

SPEED, DEEP, DIP, SPAN = 9.0, 3.6, (12.0, 88.0), (42.0, 60.0)
"""Metres a second; how deep the street dips, and where; and where the bridge is."""

HALF, LOW, HIGH, CLEAR = 5.5, -20.0, 180.0, 4.4
"""Metres: half of the road with its pavements, where it begins and ends, and from its lowest place to the bridge."""

PIECE = 2.0
"""Metres of road that are plane."""

STOPS, SETTLES = 1.8, 0.5
"""How many stops longer it is exposed under the bridge, and seconds in which most of that is done."""


def height(x: np.ndarray) -> np.ndarray:
    """Metres above the country of the road at x."""
    part = ((np.asarray(x, np.float64) - DIP[0]) / (DIP[1] - DIP[0])).clip(0, 1)
    return -DEEP / 2 * (1 - np.cos(2 * np.pi * part))


def underpass(meshes: Path, seed: int = 4) -> Place:
    """meshes: the folder with the cars' GLB files."""
    chance = np.random.default_rng(seed)
    models = models_in(meshes)
    times = clock(FRAMES + 1, STEP_US)
    movers = (
        car("ahead", models["hatchback_blue"], [(16.0, -1.8), (200.0, -1.8)], 9.6, times),
        car("coming", models["pickup"], [(105.0, 1.8), (-60.0, 1.8)], 8.5, times),
        walker("along", [(30.0, -4.6), (60.0, -4.6)], 1.4, times, 20),
    )
    ego = over(along([(x, 0.15 * math.sin(x / 15) - 1.8) for x in np.arange(-2.0, 90.0)], SPEED, times), height)
    return Place(
        "underpass",
        joined([*_road(seed), *_walls(chance), *_bridge(chance), *_country(chance)]),
        tuple(replace(m, trajectory=over(m.trajectory, height)) for m in movers),
        Light((0.3, -0.62, 0.72), (1.0, 0.94, 0.84), (0.24, 0.29, 0.36), 25.0, 0.14),
        ego,
        rig(times),
        LIDAR,
        ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0), (-1.0, 0.0), (-2.0, 0.0)),
        level=level(height),
        stops=_stops(ego),
    )


def _stops(ego: Trajectory) -> np.ndarray:
    """At what moments `[T]` it is exposed how many stops longer, `[2, T]`: as what is ahead is dark, a little late."""
    seconds = (ego.times_us - ego.times_us[0]).numpy() / 1e6
    x = ego.world_from_body[:, 0, 3].numpy() + 6.0
    wanted = STOPS * ((x > SPAN[0]) & (x < SPAN[1] - 4.0))
    told, now = [], 0.0
    for step, stop in zip(np.diff(seconds, prepend=seconds[0]), wanted, strict=True):
        now += (stop - now) * (1 - math.exp(-step / SETTLES))
        told.append(now)
    return np.stack([ego.times_us.numpy(), told])


def _strip(low: float, high: float, ends: Sequence[tuple[float, float]], texture: np.ndarray, tile: float) -> Mesh:
    """A band along the road between two places `(y, z)` above it, the right one first."""
    marks = np.append(np.arange(low, high - 1e-6, PIECE), high)
    return strip(np.stack([marks, np.zeros(len(marks))], 1), ends, texture, tile, height)


def _road(seed: int) -> list[Mesh]:
    """Asphalt, pavements with kerbs, dashes and edge lines."""
    asphalt, flags, white = (
        grain(seed, (0.33, 0.33, 0.35), 0.12),
        grain(seed + 2, (0.58, 0.56, 0.53)),
        grain(seed + 3, (0.85, 0.85, 0.82), 0.06),
    )
    out = [_strip(LOW, HIGH, ((-HALF, 0), (HALF, 0)), asphalt, 4.7)]
    for side in (-1, 1):
        right, left = sorted((side * (HALF - 1.6), side * HALF))
        out.append(_strip(LOW, HIGH, ((right, 0.13), (left, 0.13)), flags, 3.1))
        kerb = ((right, 0.13), (right, 0.0)) if side > 0 else ((left, 0.0), (left, 0.13))
        out.append(_strip(LOW, HIGH, kerb if side < 0 else kerb[::-1], flags, 3.1))
    out += [_strip(x, x + 3.0, ((-0.07, 0.004), (0.07, 0.004)), white, 1.0) for x in np.arange(LOW, HIGH - 3, 6.0)]
    return out


def _walls(chance: np.random.Generator) -> list[Mesh]:
    """Retaining walls of concrete, stained by water, with joints, and railings on top."""
    out, steel = [], plain((0.3, 0.32, 0.34))
    for side in (-1, 1):
        for x in np.arange(DIP[0] - 4.0, DIP[1] + 4.0, 4.0):
            low = float(min(height(x), height(x + 4.0)))
            top = CLEAR - DEEP + 0.1 if SPAN[0] - 4 < x < SPAN[1] else 0.9
            along_, y = (4.0, 0, 0), side * HALF
            corner = (x, y, low) if side > 0 else (x + 4.0, y, low)
            out.append(panel(corner, along_ if side > 0 else (-4.0, 0, 0), (0, 0, top - low), _concrete(chance, top - low)))
        for x in np.arange(LOW, HIGH, 14.0):
            if not SPAN[0] - 3 < x < SPAN[1] + 3:
                out.append(box((x, side * (HALF + 0.3), float(height(x))), (0.14, 0.14, 7.0 - float(height(x))), steel))
    return out


def _concrete(chance: np.random.Generator, high: float, pixels: int = 96) -> np.ndarray:
    """A slab four metres wide, with stains that run down."""
    rows = max(16, int(pixels * high / 4))
    picture = grain(int(chance.integers(1 << 20)), (0.56, 0.55, 0.52), 0.1)[:rows, :pixels, :3] / 255
    for _ in range(3):
        at, wide, deep = chance.integers(0, pixels), chance.integers(2, 9), int(rows * chance.uniform(0.3, 1.0))
        picture[:deep, at : at + wide] *= np.linspace(chance.uniform(0.5, 0.8), 1.0, deep)[:, None, None]
    picture[:, :2] *= 0.5
    if chance.random() < 0.4:
        y, x = np.mgrid[: picture.shape[0], : picture.shape[1]]
        cy, cx = picture.shape[0] * chance.uniform(0.4, 0.7), pixels * chance.uniform(0.3, 0.7)
        picture[(abs(y - cy) < 9) & (abs(x - cx + 0.3 * (y - cy)) < 4 + 10 * (np.sin(0.8 * y) > 0.2))] = chance.uniform(0.1, 0.9, 3)
    return painted(picture)


def _bridge(chance: np.random.Generator) -> list[Mesh]:
    """A deck on girders, which are seen from below, with railings, and what stands on it."""
    under, steel = CLEAR - DEEP, grain(6, (0.34, 0.42, 0.4), 0.15, 96)
    low, high = SPAN
    concrete = grain(12, (0.5, 0.49, 0.46), 0.15)
    out = [box(((low + high) / 2, 0, under + 0.9), (high - low, 2 * HALF + 30, 0.9), concrete, 3.3)]
    out.append(panel((low, HALF + 15, under + 0.9), (high - low, 0, 0), (0, -2 * HALF - 30, 0), concrete, 3.3))
    for x in np.arange(low + 0.3, high, 2.1):
        out.append(box((x, 0, under), (0.3, 2 * HALF, 0.9), steel, 2.0))
        out.append(panel((x - 0.15, HALF, under), (0.3, 0, 0), (0, -2 * HALF, 0), steel, 2.0))
    for x in (low, high):
        out += [box((x, y, under + 1.8), (0.08, 0.08, 1.1), steel) for y in np.arange(-HALF - 8, HALF + 8, 1.5)]
        out.append(box((x, 0, under + 2.8), (0.06, 2 * HALF + 16, 0.1), steel))
    return out


def _country(chance: np.random.Generator) -> list[Mesh]:
    """Grass to both sides, with houses and trees on it."""
    grass, roof = grain(20, (0.36, 0.42, 0.28), 0.3), grain(77, (0.4, 0.25, 0.2), 0.2)
    leaves, bark = grain(8, (0.2, 0.36, 0.13), 0.5, 128), grain(9, (0.35, 0.27, 0.2), 0.3, 64)
    out = []
    for side in (-1, 1):
        edge = HALF if side > 0 else -HALF - 500
        out.append(panel((-400, edge, 0), (1000, 0, 0), (0, 500, 0), grass, 12.0))
        x = LOW
        while x < HIGH:
            width, tall = 3.0 * chance.integers(3, 6), 3.0 * chance.integers(2, 4)
            if not SPAN[0] - 4 - width < x < SPAN[1] + 4:
                wall = plaster(chance)
                out.append(box((x + width / 2, side * (HALF + 5 + chance.uniform(0, 3) + 5), 0), (width, 10.0, tall), wall, 3.0, roof))
            x += width + chance.uniform(1.5, 8.0)
        for x in np.arange(LOW, HIGH, 11.0):
            at, size = x + chance.uniform(-3, 3), chance.uniform(0.8, 1.3)
            if not SPAN[0] - 3 < at < SPAN[1] + 3 and chance.random() < 0.7:
                y = side * (HALF + 2.4)
                out.append(box((at, y, 0), (0.25, 0.25, 2.6 * size), bark, 1.0))
                out += crown(chance, (at, y, 3.6 * size), size, 6, (0.5, 0.9), leaves)
    far = facade(5, (0.6, 0.5, 0.45))
    return [*out, box((HIGH + 8, 0, 0), (10, 60, 12), far, 3.0, roof)]
