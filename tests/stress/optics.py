"""Hazards of lenses and shutters: folds, views beyond a half-space, fast readouts. With these, `HAZARDS` is complete."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch

from scenes import Camera
from scenes.lenses import Equirectangular, Fisheye, FTheta, OpenCV, Orthographic
from scenes.poses import pose_from, translation
from tests.bench.presets import random_splats
from tests.stress.hazards import HAZARDS as HAZARDS
from tests.stress.hazards import SMALL, STILL, UT, Case, ahead, hazard


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
