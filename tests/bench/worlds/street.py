"""A street in a town: houses, trees, poles and parked cars along it, a junction, oncoming, leading and crossing cars, and people."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from recon.assets.mesh_files import read_mesh
from render.tracer import Mesh
from scenes.camera import RigCamera
from tests.bench.worlds.people import walker
from tests.bench.worlds.place import Light, Mover, Part, Place, along, clock, fisheye, looking
from tests.bench.worlds.solids import box, crown, facade, grain, joined, moved, panel, plain

FRAMES, STEP_US = 80, 100_000
HALF, KERB, JUNCTION, LENGTH = 6.5, 0.13, (62.0, 72.0), (-20.0, 140.0)
"""Metres: half of the road's width, the pavement's height, where a street crosses, and where houses begin and end."""

CARS = ("hatchback", "hatchback_blue", "hatchback_red", "pickup", "prius_hybrid")
SPEED, READOUT_US = 6.0, 30_000
STANDING = (
    ("fire_hydrant", 18.0, -HALF - 0.6),
    ("postbox", 24.0, HALF + 0.8),
    ("dumpster", 36.0, -HALF - 2.4),
    ("construction_cone", 47.0, -HALF + 0.9),
    ("postbox", 52.0, -HALF - 0.8),
    ("stop_sign", JUNCTION[0] - 1.5, -HALF - 0.6),
)
"""Models, and where they stand, metres along and to the left."""

LIGHT = Light((0.45, -0.5, 0.74), (1.0, 0.92, 0.8), (0.22, 0.27, 0.34), 25.0)
LIDAR = (tuple(np.linspace(-24.0, 12.0, 48).tolist()), (1.2, 0.0, 1.85))
"""As of `Place`."""


def street(meshes: Path, seed: int = 0) -> Place:
    """meshes: the folder with the cars' and the street furniture's GLB files."""
    chance = np.random.default_rng(seed)
    models = models_in(meshes)
    times = clock(FRAMES + 1, STEP_US)
    return Place(
        "street",
        joined([*ground(seed), *houses(chance), *furniture(chance, models), *parked(chance, models)]),
        tuple(_movers(models, times)),
        LIGHT,
        along([(x, 0.25 * math.sin(x / 12) - 2.2) for x in np.arange(-2.0, 60.0)], SPEED, times),
        rig(times),
        LIDAR,
        ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0), (-1.0, 0.0), (-1.5, 0.0)),
    )


def models_in(meshes: Path) -> dict[str, Mesh]:
    """The GLB files of a folder, by their names."""
    return {p.stem: read_mesh(p) for p in sorted(meshes.glob("*.glb"))}


def rig(times_us: torch.Tensor) -> dict[str, RigCamera]:
    """A car's cameras that take a picture at all but the last of these times: ahead, one that is read out row by row, one of a fisheye's
    whole circle, and to the left."""
    at, times = (1.5, 0.0, 1.55), times_us[:-1]
    front = looking((480, 270), 64.0, 0.0, at, times)
    return {
        "front": front,
        "rolling": replace(front, shutter="rows", readout_us=READOUT_US),
        "fisheye": fisheye((480, 360), 190.0, at, times),
        "left": looking((480, 270), 64.0, 75.0, at, times),
    }


def plaster(chance: np.random.Generator) -> np.ndarray:
    """A house's wall in a light colour of its own."""
    return facade(int(chance.integers(1 << 20)), tuple(chance.uniform(0.4, 0.8) * (1 + chance.uniform(-0.12, 0.12, 3))))


def ground(seed: int) -> list[Mesh]:
    """Road, side street, pavements with kerbs, dashes, a crossing, patches of newer asphalt, and the country beyond."""
    asphalt, patch = grain(seed, (0.34, 0.34, 0.36), 0.12), grain(seed + 1, (0.25, 0.25, 0.27), 0.12)
    flags, white = grain(seed + 2, (0.6, 0.57, 0.53)), grain(seed + 3, (0.85, 0.85, 0.82), 0.06)
    low, high = LENGTH
    out = [panel((low, -HALF, 0), (high - low, 0, 0), (0, 2 * HALF, 0), asphalt, 4.0)]
    out.append(panel((JUNCTION[0], -60, 0.001), (JUNCTION[1] - JUNCTION[0], 0, 0), (0, 120, 0), asphalt, 4.0))
    out.append(panel((-600, -600, -0.05), (1200, 0, 0), (0, 1200, 0), grain(seed + 4, (0.38, 0.42, 0.3)), 30.0))
    for start, end in ((low, JUNCTION[0]), (JUNCTION[1], high)):
        for side in (-1, 1):
            out.append(box(((start + end) / 2, side * (HALF + 2.0), 0), (end - start, 4.0, KERB), flags, 3.0))
    for x in np.arange(low, high, 6.0):
        if not JUNCTION[0] - 4 < x < JUNCTION[1] + 1:
            out.append(panel((x, -0.07, 0.003), (3.0, 0, 0), (0, 0.14, 0), white, 1.0))
    for y in np.arange(-HALF + 0.4, HALF - 0.5, 1.0):
        out.append(panel((JUNCTION[0] - 3.5, y, 0.003), (2.6, 0, 0), (0, 0.5, 0), white, 1.0))
    for x, y, length, width in ((9, -4.4, 5, 1.6), (27, 0.6, 3, 2.5), (41, -3.0, 8, 0.8), (55, 1.5, 2, 2)):
        out.append(panel((x, y, 0.002), (length, 0, 0), (0, width, 0), patch, 4.0))
    return out


def houses(chance: np.random.Generator) -> list[Mesh]:
    """Rows of houses to both sides, of several widths, heights and setbacks, and one row that closes the street; bays repeat every 3 m."""
    out, roof = [], grain(77, (0.4, 0.25, 0.2), 0.2)
    for side in (-1, 1):
        x = LENGTH[0]
        while x < LENGTH[1]:
            width, height = 3.0 * chance.integers(3, 6), 3.0 * chance.integers(2, 5)
            if x < JUNCTION[1] + 4 and x + width > JUNCTION[0] - 4:
                x = JUNCTION[1] + 4
                continue
            y = side * (HALF + 4 + chance.uniform(0, 2.5) + 5)
            wall = plaster(chance)
            out.append(box((x + width / 2, y, 0), (width, 10.0, height), wall, 3.0, roof))
            door = grain(int(chance.integers(1 << 20)), tuple(chance.uniform(0.1, 0.5, 3)), 0.1, 64)
            out.append(box((x + chance.uniform(1, width - 1), y - side * 5.05, 0), (1.1, 0.2, 2.2), door))
            if chance.random() < 0.5:
                out.append(box((x + width / 2, y - side * 5.5, 2.8), (width * 0.6, 1.0, 0.15), door, 1.0))  # an awning
            x += width + chance.choice([0.0, 0.0, 1.5])
    far = facade(5, (0.6, 0.5, 0.45))
    return [*out, box((LENGTH[1] + 10, 0, 0), (10, 40, 15), far, 3.0, roof)]


def furniture(chance: np.random.Generator, models: dict[str, Mesh]) -> list[Mesh]:
    """Trees, lamp posts, and what else stands on pavements."""
    leaves, bark, steel = grain(8, (0.2, 0.36, 0.13), 0.5, 128), grain(9, (0.35, 0.27, 0.2), 0.3, 64), plain((0.35, 0.37, 0.38))
    out = []
    for x in np.arange(-12.0, 130.0, 13.0):
        for side in (-1, 1):
            at = x + chance.uniform(-2, 2)
            if JUNCTION[0] - 3 < at < JUNCTION[1] + 3:
                continue
            y, size = side * (HALF + 0.9), chance.uniform(0.8, 1.2)
            if chance.random() < 0.6:
                out.append(box((at, y, KERB), (0.25, 0.25, 2.6 * size), bark, 1.0))
                out += crown(chance, (at, y, 3.6 * size), size, 7, (0.5, 0.9), leaves)
            else:
                out.append(box((at, y, KERB), (0.14, 0.14, 6.5), steel))
                out.append(box((at, y - side * 0.8, 6.5), (0.2, 1.8, 0.12), steel))
    for name, x, y in STANDING:
        out.append(moved(models[name], (x, y, 0.0 if name == "construction_cone" else KERB), math.pi / 2))
    return out


def parked(chance: np.random.Generator, models: dict[str, Mesh]) -> list[Mesh]:
    """Cars along both kerbs, with gaps."""
    out = []
    for side in (-1, 1):
        x = -10.0
        while x < 120.0:
            x += chance.uniform(5.6, 8.0)
            if chance.random() < 0.6 and not JUNCTION[0] - 8 < x < JUNCTION[1] + 5:
                car = models[CARS[chance.integers(len(CARS))]]
                out.append(moved(car, (x, side * (HALF - 1.15), 0), math.pi * (side > 0) + chance.uniform(-0.03, 0.03)))
    return out


def car(track: str, mesh: Mesh, points: list[tuple[float, float]], speed: float, times: torch.Tensor) -> Mover:
    """A car that goes through points `[x, y]` at a speed in m/s."""
    size = tuple((mesh.vertices.max(0) - mesh.vertices.min(0)).tolist())
    return Mover(track, "car", size, (Part(mesh),), along(points, speed, times))


def _movers(models: dict[str, Mesh], times: torch.Tensor) -> list[Mover]:
    """A car ahead, two that come, one that crosses, someone who crosses, and two who walk along the houses."""
    return [
        car("ahead", models["prius_hybrid"], [(14.0, -2.2), (90.0, -2.2)], 6.5, times),
        car("coming", models["hatchback_red"], [(70.0, 2.6), (-40.0, 2.6)], 7.0, times),
        car("second", models["pickup"], [(118.0, 2.7), (-40.0, 2.7)], 8.0, times),
        car("crossing", models["hatchback_blue"], [(69.5, 30.0), (69.5, -40.0)], 5.0, times),
        walker("crosses", [(58.0, -8.0), (58.0, 8.0)], 1.4, times, 20),
        walker("along", [(12.0, -7.2), (30.0, -7.2)], 1.3, times, 30),
        walker("towards", [(45.0, 7.0), (30.0, 7.0)], 1.5, times, 40),
    ]
