"""Scenes drawn by lot from all lenses, shutters, models, responses and orders, against the float64 oracle."""

import random
from dataclasses import replace

import pytest
import torch

from render import RenderConfig, rasterize
from scenes import Equirectangular, Placed, SplatModel
from tests import oracle
from tests.render.test_lenses import LENSES, around, camera_of, stretched
from tests.render.test_rasterize import largest, needles_and_pancakes, off_axis_and_close, two_instances
from tests.render.test_shutter import PINHOLE, crash, driven, traffic

STILL = (two_instances, needles_and_pancakes, off_axis_and_close, around, stretched, traffic, crash)
MOVING = (two_instances, needles_and_pancakes, traffic, crash)
"""Without splats through which the camera drives while it reads out: their footprint has no bound, in the oracle either."""


def changed(placed: list[Placed], larger: float, denser: float) -> list[Placed]:
    """With all axes and opacities scaled, as logarithm and logit."""
    return [
        replace(
            p,
            gaussians=replace(
                p.gaussians,
                log_scales=p.gaussians.log_scales + larger,
                logit_opacities=p.gaussians.logit_opacities + denser,
            ),
        )
        for p in placed
    ]


@pytest.mark.parametrize("part", range(6))
def test_scenes_by_lot_are_drawn_as_the_oracle_draws_them(part):
    for seed in range(12 * part, 12 * part + 12):
        dice = random.Random(seed)
        moving = dice.random() < 0.4
        make, lens = dice.choice(MOVING if moving else STILL), dice.choice([PINHOLE, *LENSES.values()])
        shutter = "rows" if isinstance(lens, Equirectangular) else dice.choice(["rows", "columns"])
        camera = driven(lens, shutter, dice.uniform(0, 40), dice.uniform(-100, 100)) if moving else camera_of(lens)
        projection, response = "ut" if moving else dice.choice(["ut", "ewa"]), dice.choice(["conic", "ray"])
        model = SplatModel(projection=projection, antialias=dice.random() < 0.5, response=response)
        order = dice.choice(["tile", "pixel"])
        placed = changed(make(seed), dice.choice([0.0, 0.0, dice.uniform(-3, 1)]), dice.choice([0.0, 0.0, dice.uniform(-4, 6)]))
        if not moving:
            placed = [replace(p, world_from_local_end=None) for p in placed]
        model = replace(model, smoothing=dice.choice([0.0, 0.1]))
        with torch.no_grad():
            rgb, *_, unsure = oracle.render(
                oracle.as_oracle(placed), camera, model, cutoff=1 / 255, alpha_max=0.999, order=order,
                world_from_cam_end=camera.world_from_cam_end, ends=[p.world_from_local_end for p in placed],
            )  # fmt: skip
        drawn = rasterize(placed, camera, ("rgb",), model=model, config=RenderConfig(termination=0, order=order)).rgb
        off = largest(drawn, rgb, ~unsure)
        which = f"scene {seed}: {make.__name__}, {lens.kind}, {shutter if moving else 'still'}, {response}, {order}, {model}"
        assert off < 5e-6 * max(1.0, float(rgb.max())), f"{which}: off by {off:.1e}"
