"""Every hazard's pictures come out finite, with finite gradients, in bounded memory, and like the oracle's where it can follow."""

import math
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from render import rasterize
from scenes import Camera, Gaussians, Pinhole, Placed, SplatModel
from scenes.poses import translation
from tests.bench.presets import random_splats
from tests.stress.hazards import HAZARDS, SMALL, Case, ahead, examine, run

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here"))]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", HAZARDS)
def test_hazard(name, device, hazard_table):
    outcome = run(name, device)
    hazard_table[f"{name} ({device})"] = outcome
    assert outcome.cases and not outcome.failures


NASTY = st.one_of(
    st.floats(-3, 3, width=32),
    st.sampled_from([0.0, -0.0, 1e-45, 1e-30, -1e-30, 1e30, -1e30, 3e38, 88.0, -88.0, 100.0, -104.0, math.nan, math.inf, -math.inf]),
)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(NASTY, min_size=60, max_size=60),
    st.sampled_from(["ewa", "ut"]),
    st.booleans(),
    st.sampled_from([(1, 1), (17, 5), (40, 30)]),
)
def test_any_numbers_at_all_leave_picture_and_gradients_finite(values, projection, antialias, size):
    n = 60 // 14
    v = torch.tensor(values[: 14 * n], dtype=torch.float32).reshape(n, 14)
    g = Gaussians(v[:, :3], v[:, 3:7], v[:, 7:10], v[:, 10], v[:, None, 11:14])
    camera = Camera(Pinhole(20.0, 20.0, size[0] / 2, size[1] / 2), *size, torch.eye(4, dtype=torch.float64))
    case = Case("drawn", ahead(g), camera, SplatModel(projection=projection, antialias=antialias), truth=False)
    assert examine(case) == []


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(0, 2**31), st.floats(-6, 2), st.floats(0.3, 12), st.sampled_from(["ewa", "ut"]), st.booleans())
def test_any_ordinary_cloud_agrees_with_the_oracle(n, seed, log_scale, z, projection, antialias):
    g = random_splats(n, seed)
    g = Gaussians(g.means, g.quats, g.log_scales + log_scale, g.logit_opacities, g.sh)
    assert examine(Case("drawn", ahead(g, z), SMALL, SplatModel(projection=projection, antialias=antialias))) == []


def test_a_splat_that_is_not_a_number_is_named_and_changes_no_picture():
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        g = random_splats(60, 14)
        without = g.select(torch.arange(60) != 7)
        getattr(g, name)[7] = math.nan
        with pytest.raises(ValueError, match=f"splat 7 has nan in {name}"):
            g.validate()
        assert torch.equal(*(rasterize(ahead(x), SMALL).rgb for x in (g, without))), name


def test_an_exception_in_the_middle_leaves_nothing_behind(monkeypatch):
    import render.bridge as bridge

    placed = ahead(random_splats(200, 15))
    before = rasterize(placed, SMALL).rgb
    threads = torch.get_num_threads()

    def fail(*arguments, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr(bridge, "tile_lists", fail)
    with pytest.raises(KeyboardInterrupt):
        rasterize(placed, SMALL)
    monkeypatch.undo()
    assert torch.get_num_threads() == threads and torch.equal(rasterize(placed, SMALL).rgb, before)


def test_renders_in_two_threads_at_once_do_not_mix():
    clouds = [Placed(random_splats(300, 16 + i), translation(0, 0, 5)) for i in range(2)]

    def train(cloud):
        g = cloud.gaussians.map(lambda t: t.clone().requires_grad_())
        rasterize(Placed(g, cloud.world_from_local), SMALL).rgb.square().sum().backward()
        return [t.grad for t in g.tensors().values()]

    alone = [train(c) for c in clouds]
    with ThreadPoolExecutor(2) as pool:
        for _ in range(5):
            for mine, together in zip(alone, pool.map(train, clouds), strict=True):
                assert all(torch.equal(a, b) for a, b in zip(mine, together, strict=True))
