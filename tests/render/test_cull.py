"""What is culled before projection changes no pixel."""

import sys
from dataclasses import replace

import pytest
import torch

import render.cull as cull
from render import rasterize
from render.bands import without_zero_bands
from render.cull import bounds, differentiated, in_sight
from render.kernels.types import ITEM
from scenes import Camera, Gaussians, Pinhole, Placed, SplatModel
from scenes.poses import pose_from, translation
from tests.bench.presets import random_splats

STILL = torch.eye(4, dtype=torch.float64)
CAMERA = Camera(Pinhole(60.0, 62.0, 34.0, 22.0), 70, 50, STILL)


@pytest.fixture(autouse=True)
def small_clusters(monkeypatch):
    monkeypatch.setattr(cull, "CLUSTER", ITEM)


def scattered(seed: int, count: int = 60) -> Gaussians:
    """Clusters all around the camera, each ITEM splats in a row."""
    dice = torch.Generator().manual_seed(seed)
    g = random_splats(ITEM * count, seed, sh_count=4, spread=0.4)
    places = torch.randn(count, 3, generator=dice) * torch.tensor([8.0, 8.0, 8.0])
    return replace(g, means=g.means + places.repeat_interleave(ITEM, 0))


@pytest.mark.parametrize("seed", range(5))
def test_a_picture_of_what_is_in_sight_is_the_picture_of_all(seed, monkeypatch):
    turned = replace(CAMERA, world_from_cam=pose_from([0.9, 0.3 * seed, -0.2, 0.1], [1.0, 0.0, 0.0]))
    placed = [Placed(scattered(seed), translation(0, 0, 2)), Placed(scattered(seed + 9, 3), translation(0, 1, 3), instance=4)]
    seen = in_sight(placed, turned, SplatModel())
    assert 0 < int(sum(s.sum() for s in seen)) < 0.7 * sum(len(p.gaussians) for p in placed) / ITEM
    outputs = ("rgb", "depth", "instance", "normal", "features")
    features = torch.randn(sum(len(p.gaussians) for p in placed), 2, generator=torch.Generator().manual_seed(seed))
    culled = rasterize(placed, turned, outputs, features=features)
    monkeypatch.setattr(sys.modules["render.rasterize"], "in_sight", lambda placed, *_: None)
    whole = rasterize(placed, turned, outputs, features=features)
    for name, picture in culled.outputs().items():
        assert torch.equal(picture, getattr(whole, name)), name


def test_an_instance_behind_the_camera_is_not_drawn_at_all():
    here, behind = Placed(random_splats(20, 1), translation(0, 0, 5)), Placed(random_splats(20, 2), translation(0, 0, -9), instance=1)
    assert [s.tolist() for s in in_sight([behind, here], CAMERA, SplatModel())] == [[False], [True]]
    assert rasterize([behind], CAMERA, ("alpha",)).alpha.max() == 0


def test_bounds_are_kept_until_the_splats_change():
    g = scattered(3)
    first = bounds(g)
    assert bounds(g) is first
    g.means[0, 0] += 100.0
    assert bounds(g) is not first and bounds(g)[1][0] > 40


def test_what_needs_gradients_is_not_culled():
    features = torch.ones(20, 1).requires_grad_()
    behind = Placed(random_splats(20, 2), translation(0, 0, -9))
    rasterize(behind, CAMERA, ("features",), features=features).features.sum().backward()
    assert features.grad.shape == (20, 1) and features.grad.abs().max() == 0
    g = random_splats(20, 2).map(lambda t: t.requires_grad_())
    behind = [Placed(g, translation(0, 0, -9))]
    rasterize(behind, CAMERA).rgb.sum().backward()
    assert g.means.grad.abs().max() == 0


@pytest.mark.parametrize("asked", ["world_from_cam", "world_from_cam_end", "world_from_local", "world_from_local_end", "sh"])
def test_gradients_of_any_one_thing_are_asked_for(asked):
    """Of a pose at a readout's end alone, too."""
    placed, camera = (
        Placed(random_splats(3, 2), STILL, world_from_local_end=STILL),
        replace(CAMERA, shutter="rows", world_from_cam_end=STILL),
    )
    assert not differentiated([placed], camera)
    traced = STILL.clone().requires_grad_()
    if asked == "sh":
        placed = replace(placed, gaussians=replace(placed.gaussians, sh=placed.gaussians.sh.clone().requires_grad_()))
    elif asked.startswith("world_from_cam"):
        camera = replace(camera, **{asked: traced})
    else:
        placed = replace(placed, **{asked: traced})
    assert differentiated([placed], camera)
    with torch.no_grad():
        assert not differentiated([placed], camera)


@pytest.mark.parametrize(("stored", "used"), [(16, 16), (16, 9), (16, 4), (16, 1), (9, 4), (4, 1)])
def test_bands_that_are_zero_are_left_out_and_change_no_bit(stored, used):
    g = random_splats(100, 6, sh_count=stored)
    g.sh[:, used:] = 0
    assert without_zero_bands(g).sh.shape[1] == used
    placed = Placed(g, translation(0, 0, 5))
    trimmed = rasterize(placed, CAMERA).rgb
    assert torch.equal(trimmed, rasterize(replace(placed, gaussians=g.map(lambda t: t.requires_grad_())), CAMERA).rgb)
    with torch.no_grad():
        g.sh[3, stored - 1] = 0.5
    assert without_zero_bands(g).sh.shape[1] == stored


def test_a_splat_that_is_not_a_number_hides_no_neighbour():
    g = scattered(4)
    g.means[5] = torch.nan
    culled = rasterize(Placed(g, translation(0, 0, 2)), CAMERA).rgb
    alive = g.select(torch.arange(len(g)) != 5)
    assert torch.equal(culled, rasterize(Placed(alive, translation(0, 0, 2)), CAMERA).rgb)
