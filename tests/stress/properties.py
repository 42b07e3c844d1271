"""Properties that must hold of any splats: hypothesis looks for the ones that break them."""

from __future__ import annotations

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes import Camera, Gaussians, Pinhole, SplatModel
from tests.bench.presets import random_splats
from tests.stress.hazards import SMALL, STILL, Case, Outcome, ahead, examine

NASTY = st.one_of(
    st.floats(-3, 3, width=32),
    st.sampled_from([0.0, -0.0, 1e-45, 1e-30, -1e-30, 1e30, -1e30, 3e38, 88.0, -88.0, 100.0, -104.0, math.nan, math.inf, -math.inf]),
)
MODELS = st.builds(
    SplatModel,
    projection=st.sampled_from(["ewa", "ut"]),
    antialias=st.booleans(),
    dilation=st.sampled_from([0.0, 0.3]),
    smoothing=st.sampled_from([0.0, 0.1]),
)


@st.composite
def any_numbers_at_all(draw) -> Case:
    """Four splats of any floats there are, not-a-number included: finite picture, finite gradients."""
    v = torch.tensor(draw(st.lists(NASTY, min_size=56, max_size=56)), dtype=torch.float32).reshape(4, 14)
    # the gradients of a colour near the largest float are beyond it
    g = Gaussians(v[:, :3], v[:, 3:7], v[:, 7:10], v[:, 10], v[:, None, 11:14].clamp(-1e4, 1e4))
    width, height = draw(st.sampled_from([(1, 1), (17, 5), (40, 30)]))
    return Case("drawn", ahead(g), Camera(Pinhole(20.0, 20.0, width / 2, height / 2), width, height, STILL), draw(MODELS), truth=False)


@st.composite
def any_ordinary_cloud(draw) -> Case:
    """Agrees with the oracle, whatever its size and distance."""
    g = random_splats(draw(st.integers(1, 40)), draw(st.integers(0, 2**31)))
    g = Gaussians(g.means, g.quats, g.log_scales + draw(st.floats(-6, 2)), g.logit_opacities, g.sh)
    model = SplatModel(projection=draw(st.sampled_from(["ewa", "ut"])), antialias=draw(st.booleans()))
    return Case("drawn", ahead(g, draw(st.floats(0.3, 12))), SMALL, model)


@st.composite
def any_pinhole(draw) -> Case:
    """Agrees with the oracle, wherever the lens has its centre and however long it is."""
    width, height = draw(st.integers(1, 70)), draw(st.integers(1, 50))
    focal = draw(st.floats(5, 300))
    lens = Pinhole(focal, focal * draw(st.floats(0.5, 2)), draw(st.floats(-1, 2)) * width, draw(st.floats(-1, 2)) * height)
    return Case("drawn", ahead(random_splats(30, draw(st.integers(0, 2**31)))), Camera(lens, width, height, STILL))


PROPERTIES = {
    "any numbers at all": (any_numbers_at_all, 60),
    "any ordinary cloud": (any_ordinary_cloud, 25),
    "any pinhole": (any_pinhole, 25),
}


def run_property(name: str) -> Outcome:
    """Let hypothesis look for a case that breaks the property; the smallest that it finds is the failure."""
    make, examples = PROPERTIES[name]
    outcome = Outcome()

    @settings(max_examples=examples, deadline=None, database=None)
    @given(make())
    def holds(case: Case):
        outcome.cases += 1
        wrong = examine(case)
        assert not wrong, f"{'; '.join(wrong)}: {case}"

    try:
        holds()
    except AssertionError as broken:
        outcome.failures.append(str(broken))
    return outcome
