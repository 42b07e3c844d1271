"""Streets by lot: how they wind and climb, how they are built up and lit, who is on them, and what records them. Each seed is another."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from render.tracer import Mesh
from scenes.camera import RigCamera
from scenes.poses import small_poses, translation
from scenes.poses import yaw as turn
from tests.bench.worlds.people import walker
from tests.bench.worlds.place import Light, Mover, Place, clock, gone, looking
from tests.bench.worlds.slopes import Height, level, over, stood, strip
from tests.bench.worlds.solids import box, crown, facade, grain, joined, moved, plain, posed
from tests.bench.worlds.street import CARS, FRAMES, STEP_US, car, models_in, plaster

LOW, HIGH, PIECE = -40.0, 190.0, 2.0
"""Metres along the way where it begins and ends, and of it that are plane."""

LANE, KERB = 3.4, 0.13
"""Metres: a lane's width, and how high the pavement is."""


@dataclass(frozen=True)
class Street:
    """The middle line `[K, 2]`, metres, `PIECE` between its points; half of the road's width; how high the ground is; and the side that
    is driven on, -1 the right one."""

    way: np.ndarray
    half: float
    height: Height
    side: int

    @staticmethod
    def by_lot(chance: np.random.Generator) -> Street:
        """Turning to and fro by up to 34 degrees, and up to 5 % steep."""
        marks = np.arange(LOW, HIGH, PIECE)
        winding, climb = chance.uniform(0, 0.3, 2), chance.uniform(0, 0.05)
        lengths, phases = chance.uniform(70, 200, 3), chance.uniform(0, 2 * math.pi, 3)
        heading = sum(w * np.sin(2 * np.pi * marks / n + p) for w, n, p in zip(winding, lengths, phases, strict=False))
        way = np.cumsum(PIECE * np.stack([np.cos(heading), np.sin(heading)], 1), 0)

        def height(x: np.ndarray) -> np.ndarray:
            return climb * lengths[2] / (2 * np.pi) * np.sin(2 * np.pi * np.clip(x, -1e4, 1e4) / lengths[2] + phases[2])

        return Street(way, chance.uniform(4.2, 7.0), height, -1 if chance.random() < 0.7 else 1)

    @cached_property
    def _forth(self) -> np.ndarray:
        return np.gradient(self.way, axis=0)

    def at(self, metres: float, left: float) -> torch.Tensor:
        """The pose on the ground that looks along the way, so far along it and to its left, `[4, 4]`."""
        k = (metres - LOW) / PIECE
        (x, y), (dx, dy) = ([float(np.interp(k, np.arange(len(self.way)), v[:, i])) for i in (0, 1)] for v in (self.way, self._forth))
        return stood(translation(x, y) @ turn(math.atan2(dy, dx)) @ translation(0, left), self.height)

    def points(self, first: float, last: float, left: float) -> list[tuple[float, float]]:
        """Places over the ground from one mark to another, a metre apart."""
        count = max(2, round(abs(last - first)) + 1)
        return [tuple(self.at(m, left)[:2, 3].tolist()) for m in np.linspace(first, last, count)]

    def upright(self, mesh: Mesh, metres: float, left: float, up: float = 0.0) -> Mesh:
        """What stands plumb on the ground, turned as the way is."""
        pose = self.at(metres, left)
        return moved(mesh, (*pose[:2, 3].tolist(), float(pose[2, 3]) + up), math.atan2(float(pose[1, 0]), float(pose[0, 0])))


def town(meshes: Path, seed: int) -> Place:
    """meshes: the folder with the cars' GLB files."""
    chance = np.random.default_rng([seed, 77])
    models, times, street = models_in(meshes), clock(FRAMES + 1, STEP_US), Street.by_lot(chance)
    metres, lane = _drive(chance, times), street.side * min(LANE, street.half - 2.3) / 2
    crossing = float(metres[-1]) + chance.uniform(5, 15)
    cars = _parked(street, chance, models, lane, crossing)
    still = joined([*_ground(street, seed), *_built(street, chance), *_green(street, chance), *cars])
    return Place(
        f"town {seed}",
        still,
        tuple(
            replace(m, trajectory=over(m.trajectory, street.height)) for m in _movers(street, chance, models, metres, lane, crossing, times)
        ),
        _light(chance),
        over(gone(street.points(-2.0, HIGH - 10.0, lane), metres + 2.0, times), street.height),
        {"front": _camera(chance, times)},
        _lidar(chance),
        tuple((-street.side * d, 0.0) for d in (0.0, 1.0, 2.0, 3.0, -1.0)),
        level=level(street.height),
    )


def _drive(chance: np.random.Generator, times: torch.Tensor) -> np.ndarray:
    """Metres gone at each time: faster and slower, and one in four stops on the way."""
    seconds = (times - times[0]).numpy() * 1e-6
    speed = chance.uniform(4, 13) * (1 + chance.uniform(0, 0.3) * np.sin(seconds + chance.uniform(0, 6)))
    if chance.random() < 0.25:
        speed = speed * ((np.abs(seconds - chance.uniform(3, 6)) - 1.0) / 2.0).clip(0, 1)
    return np.concatenate([[0.0], np.cumsum(speed[:-1] * np.diff(seconds))])


def _light(chance: np.random.Generator) -> Light:
    """A sun anywhere above 12 degrees, the redder the lower it is."""
    high, around = math.radians(chance.uniform(12, 65)), chance.uniform(0, 2 * math.pi)
    sun = (math.cos(high) * math.cos(around), math.cos(high) * math.sin(around), math.sin(high))
    red = max(0.0, 1 - high / math.radians(40))
    strength = chance.uniform(0.5, 1.1)
    return Light(sun, (strength, strength * (0.93 - 0.2 * red), strength * (0.82 - 0.4 * red)), (0.23, 0.28, 0.35), 25.0, 0.1)


def _camera(chance: np.random.Generator, times: torch.Tensor) -> RigCamera:
    """From 45 to 100 degrees wide, nodding by some, half of them read out row by row."""
    camera = looking((480, 270), chance.uniform(45, 100), 0.0, (1.4, chance.uniform(-0.3, 0.3), chance.uniform(1.2, 2.2)), times[:-1])
    nod = small_poses(torch.tensor([math.radians(chance.uniform(-5, 3)), 0, 0, 0, 0, 0], dtype=torch.float64))
    camera = replace(camera, body_from_cam=camera.body_from_cam @ nod)
    readout = int(chance.integers(5, 35)) * 1000
    return camera if chance.random() < 0.5 else replace(camera, shutter="rows", readout_us=readout)


def _lidar(chance: np.random.Generator) -> tuple[tuple[float, ...], tuple[float, float, float]]:
    beams = int(chance.choice([16, 32, 64]))
    return tuple(np.linspace(-chance.uniform(15, 25), chance.uniform(2, 15), beams).tolist()), (1.0, 0.0, chance.uniform(1.8, 2.3))


def _ground(street: Street, seed: int) -> list[Mesh]:
    """Road, pavements with kerbs, dashes, and the country beyond."""
    asphalt, white = grain(seed, (0.34, 0.34, 0.36), 0.12), grain(seed + 3, (0.85, 0.85, 0.82), 0.06)
    flags, grass = grain(seed + 2, (0.6, 0.57, 0.53)), grain(seed + 4, (0.36, 0.42, 0.28), 0.3)
    half, wide = street.half, street.half + 3.0

    def along(ends: Sequence[tuple[float, float]], texture: np.ndarray, tile: float, way: np.ndarray = street.way) -> Mesh:
        return strip(way, ends, texture, tile, street.height)

    out = [along(((-half, 0), (half, 0)), asphalt, 4.3)]
    for right, left in ((-wide, -half), (half, wide)):
        out.append(along(((right, KERB), (left, KERB)), flags, 3.0))
    out += [along(((half, 0), (half, KERB)), flags, 3.0), along(((-half, KERB), (-half, 0)), flags, 3.0)]
    out += [along(((-0.07, 0.004), (0.07, 0.004)), white, 1.0, street.way[k : k + 2]) for k in range(0, len(street.way) - 2, 3)]
    ahead = np.arange(-500.0, 800.0, 4.0)
    return [*out, strip(np.stack([ahead, 0 * ahead], 1), ((-600, -0.06), (600, -0.06)), grass, 12.0, street.height)]


def _built(street: Street, chance: np.random.Generator) -> list[Mesh]:
    """Houses, close together as in a town or apart as in a suburb, some behind fences, and one that closes the street."""
    roof, wood = grain(77, (0.4, 0.25, 0.2), 0.2), grain(78, (0.5, 0.42, 0.33), 0.25, 64)
    apart, back, fenced, storeys = chance.choice([0.5, 4.0, 12.0]), chance.uniform(0.0, 6.0), chance.uniform(0, 0.7), chance.integers(2, 6)
    out = []
    for side in (-1, 1):
        s = LOW
        while s < HIGH:
            width, tall = 3.0 * chance.integers(3, 6), 3.0 * chance.integers(1, storeys + 1)
            aside = street.half + 3.2 + back + chance.uniform(0, 2.0)
            house = box((0, 0, 0), (width, 10.0, tall), plaster(chance), 3.0, roof)
            out.append(street.upright(house, s + width / 2, side * (aside + 5), -0.4))
            if back > 2.0 and chance.random() < fenced:
                out += [street.upright(bar, m, side * (street.half + 3.1)) for m, bar in _fence(s, s + width, wood)]
            s += width + chance.uniform(0, 2 * apart)
    end = box((0, 0, 0), (10, 60, 12), facade(5, (0.6, 0.5, 0.45)), 3.0, roof)
    return [*out, street.upright(end, HIGH - 3.0, 0.0, -0.5)]


def _fence(first: float, last: float, wood: np.ndarray) -> Iterator[tuple[float, Mesh]]:
    """Pickets, and what holds them, and where along the way."""
    picket, rail = box((0, 0, 0), (0.09, 0.03, 1.1), wood), box((0, 0, 0.8), (1.0, 0.04, 0.08), wood)
    yield from ((m, picket) for m in np.arange(first, last, 0.2))
    yield from ((m + 0.5, rail) for m in np.arange(first, last, 1.0))


def _green(street: Street, chance: np.random.Generator) -> list[Mesh]:
    """Trees, hedges and lamp posts."""
    leaves, bark, steel = grain(8, (0.2, 0.36, 0.13), 0.5, 128), grain(9, (0.35, 0.27, 0.2), 0.3, 64), plain((0.35, 0.37, 0.38))
    apart, trees = chance.uniform(7, 20), chance.uniform(0.2, 0.9)
    out = []
    for s in np.arange(LOW, HIGH - 8, apart):
        for side in (-1, 1):
            at, left, size = s + chance.uniform(-2, 2), side * (street.half + 0.8), chance.uniform(0.7, 1.4)
            if chance.random() < trees:
                trunk = box((0, 0, 0), (0.25, 0.25, 2.6 * size), bark, 1.0)
                tree = joined([trunk, *crown(chance, (0, 0, 3.6 * size), size, 7, (0.5, 0.9), leaves)])
                out.append(street.upright(tree, at, left))
            elif chance.random() < 0.6:
                lamp = [box((0, 0, 0), (0.14, 0.14, 6.5), steel), box((0, -side * 0.8, 6.5), (0.2, 1.8, 0.12), steel)]
                out.append(street.upright(joined(lamp), at, left))
            elif chance.random() < 0.5:
                hedge = box((0, 0, 0), (chance.uniform(2, 6), 0.8, chance.uniform(0.7, 1.5)), leaves, 1.5)
                out.append(street.upright(hedge, at, left))
    return out


def _parked(street: Street, chance: np.random.Generator, models: dict[str, Mesh], lane: float, crossing: float) -> list[Mesh]:
    """Cars along those kerbs that leave the lanes room, and not where people cross."""
    out, dense = [], chance.uniform(0, 0.8)
    for side in (-1, 1):
        left = side * (street.half - 1.1)
        if abs(left) - abs(lane) < 2.4:
            continue
        s = LOW + 10
        while s < HIGH - 20:
            s += chance.uniform(5.6, 8.0)
            if chance.random() < dense and abs(s - crossing) > 4.0:
                pose = street.at(s, left) @ turn(math.pi * (side != street.side) + chance.uniform(-0.03, 0.03))
                out.append(posed(models[CARS[chance.integers(len(CARS))]], pose.numpy()))
    return out


def _movers(
    street: Street,
    chance: np.random.Generator,
    models: dict[str, Mesh],
    metres: np.ndarray,
    lane: float,
    crossing: float,
    times: torch.Tensor,
) -> list[Mover]:
    """Cars ahead and coming, and people on the pavements and across the street."""
    seconds, out = float(times[-1] - times[0]) * 1e-6, []

    def model() -> Mesh:
        return models[CARS[chance.integers(len(CARS))]]

    if chance.random() < 0.6:
        ahead, faster = chance.uniform(10, 25), chance.uniform(0, 1.5)
        path = gone(street.points(ahead, HIGH - 10, lane), metres + faster * np.linspace(0, seconds, len(metres)), times)
        out.append(replace(car("ahead", model(), street.points(0, 2, lane), 1.0, times), trajectory=path))
    slowest = math.inf  # nobody drives into the one before
    for k in range(int(chance.integers(0, 4))):
        first, slowest = 40.0 + 30.0 * k + chance.uniform(0, 15), min(slowest, chance.uniform(5, 10))
        out.append(car(f"coming {k}", model(), street.points(first, LOW + 2, -lane), slowest, times))
    for k in range(int(chance.integers(0, 5))):
        first, side = chance.uniform(10, float(metres[-1]) + 20), chance.choice([-1, 1])
        last = first + chance.choice([-1, 1]) * 12.0
        out.append(walker(f"walks {k}", street.points(first, last, side * (street.half + chance.uniform(1.6, 2.6))), 1.4, times, 20 + k))
    if chance.random() < 0.5:
        across = [tuple(street.at(crossing, left)[:2, 3].tolist()) for left in (-street.half - 1, street.half + 1)]
        out.append(walker("crosses", across, 1.3, times, 30))
    return out
