"""Hazards of lenses and shutters: folds, views beyond a half-space, fast readouts. With these, `HAZARDS` is complete."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch

from scenes import Camera, Pinhole, SplatModel
from scenes.lenses import Equirectangular, Fisheye, FTheta, OpenCV, Orthographic
from scenes.poses import pose_from, translation
from tests.bench.presets import random_splats
from tests.stress.hazards import HAZARDS as HAZARDS
from tests.stress.hazards import SMALL, STILL, UT, Case, ahead, hazard, with_one


@hazard
def distortion_past_its_fold() -> Iterator[Case]:
    """Barrel and pincushion far beyond any real lens: outside the fold nothing is drawn."""
    g = random_splats(80, 31)
    wide = replace(g, means=g.means * torch.tensor([4.0, 3.0, 1.0]))
    for numbers in ({"k1": -0.8}, {"k1": -0.3, "k2": 0.1, "k3": -0.05}, {"k1": 2.0}, {"p1": 0.1, "p2": -0.1}):
        lens = OpenCV(40.0, 41.0, 35.0, 25.0, **numbers)
        yield Case(str(numbers), ahead(wide, 3), replace(SMALL, lens=lens), UT)


@hazard
def fisheyes_beyond_a_half_space() -> Iterator[Case]:
    """Splats in front, beside and behind a lens that sees 190 degrees and more."""
    around = random_splats(150, 32, spread=4.0)
    for degrees in (120, 190, 230):
        focal = 25.0 / math.radians(degrees / 2)
        yield Case(f"fisheye, {degrees} degrees", ahead(around, 0), replace(SMALL, lens=Fisheye(focal, focal, 35.0, 25.0)), UT)
        yield Case(f"f-theta, {degrees} degrees", ahead(around, 0), replace(SMALL, lens=FTheta(35.0, 25.0, focal)), UT)


@hazard
def views_all_around_and_without_perspective() -> Iterator[Case]:
    around = random_splats(150, 33, spread=4.0)
    sphere = Camera(Equirectangular.whole(96, 48), 96, 48, STILL)
    yield Case("equirectangular", ahead(around, 0), sphere, UT)
    yield Case("orthographic", ahead(random_splats(80, 34)), replace(SMALL, lens=Orthographic(8.0, 8.0, 35.0, 25.0)), UT)


@hazard
def fast_readouts() -> Iterator[Case]:
    """30 m/s and 100 degrees a second over a readout of 30 ms, by rows and by columns; and the most that may turn, 60 degrees."""
    g = random_splats(80, 35)
    for name, turn, metres in (("a car", math.radians(3), 0.9), ("a crash", math.radians(59), 4.0)):
        end = pose_from([math.cos(turn / 2), 0, math.sin(turn / 2), 0], [metres, 0, 0])
        for shutter in ("rows", "columns"):
            camera = replace(SMALL, shutter=shutter, world_from_cam_end=end)
            yield Case(f"{name}, {shutter}", ahead(g), camera, UT, truth=False)
    oncoming = replace(ahead(g)[0], world_from_local_end=translation(0, 0, 3.2))
    yield Case("oncoming at 60 m/s", [oncoming], replace(SMALL, shutter="rows"), UT, truth=False)


RAY = SplatModel(response="ray")
OWN = {"ray": (RAY, "tile"), "ray by pixel": (RAY, "pixel"), "by pixel": (UT, "pixel")}
"""Models and orders for which every pixel looks along its own ray."""


def every_way(name: str, placed, camera: Camera = SMALL, truth: bool = False) -> Iterator[Case]:
    for way, (model, order) in OWN.items():
        yield Case(f"{name}, {way}", placed, camera, model, truth=truth, order=order)


@hazard
def rays_that_meet_anything() -> Iterator[Case]:
    """Splats that are none, thinner than an atom, wider than a city, behind the eye and around it, and equal ones."""
    for field, value in (("means", math.nan), ("quats", 0.0), ("log_scales", -80.0), ("log_scales", 60.0), ("logit_opacities", 1e30)):
        yield from every_way(f"{field} {value:g}", ahead(with_one(value, field)))
    g = random_splats(60, 36)
    yield from every_way("a flat wall", ahead(replace(g, means=g.means * torch.tensor([1.0, 1.0, 0.0]))))
    yield from every_way("copies", ahead(g.select(torch.zeros(60, dtype=torch.long))), truth=True)
    yield from every_way("around the eye", ahead(g, 0))
    small = replace(g, log_scales=g.log_scales - 1)
    yield from every_way("small", ahead(small), truth=True)
    for metres in (1e4, 1e7):
        away = pose_from([1, 0.2, 0.1, -0.3], [metres, -metres, 0.3 * metres])
        placed = [replace(p, world_from_local=away @ p.world_from_local) for p in ahead(small)]
        yield from every_way(f"{metres:g} m away", placed, replace(SMALL, world_from_cam=away), truth=True)


@hazard
def orders_without_end() -> Iterator[Case]:
    """Ten thousand splats in one tile, in no order along any ray."""
    g = random_splats(10_000, 37, sh_count=1)
    g = replace(g, means=g.means * torch.tensor([0.02, 0.02, 1.0]), log_scales=g.log_scales * torch.tensor([0.0, 0.0, 1.0]) - 4.0)
    yield Case("one tile", ahead(g, 8), replace(SMALL, lens=Pinhole(60.0, 60.0, 24.0, 24.0)), UT, truth=False, order="pixel")


@hazard
def rays_while_the_shutter_moves() -> Iterator[Case]:
    g = random_splats(60, 38)
    small = [*ahead(replace(g, log_scales=g.log_scales - 1)), replace(ahead(random_splats(20, 39))[0], instance=1)]
    small[1] = replace(small[1], world_from_local_end=translation(0.2, 0, 4.8))
    for name, turn, metres in (("a car", math.radians(3), 0.9), ("a crash", math.radians(59), 4.0)):
        end = pose_from([math.cos(turn / 2), 0, math.sin(turn / 2), 0], [metres, 0, 0])
        for shutter in ("rows", "columns"):
            yield from every_way(f"{name}, {shutter}", small, replace(SMALL, shutter=shutter, world_from_cam_end=end))
    yield from every_way("orthographic", ahead(g), replace(SMALL, lens=Orthographic(8.0, 8.0, 35.0, 25.0)))
