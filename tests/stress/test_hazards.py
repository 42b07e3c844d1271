"""Every hazard's pictures come out finite, with finite gradients, in bounded memory, and like the oracle's where it can follow."""

import math

import pytest
import torch

from render import rasterize
from tests.bench.presets import random_splats
from tests.stress.conduct import CONDUCT
from tests.stress.hazards import SMALL, ahead, run, run_conduct
from tests.stress.optics import HAZARDS
from tests.stress.properties import PROPERTIES, run_property

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here"))]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", HAZARDS)
def test_hazard(name, device, keep_row):
    outcome = run(name, device)
    keep_row(f"{name} ({device})", outcome)
    assert outcome.cases and not outcome.failures


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", CONDUCT)
def test_conduct(name, device, keep_row):
    outcome = run_conduct(CONDUCT[name], device)
    keep_row(f"{name} ({device})", outcome)
    assert not outcome.failures


@pytest.mark.parametrize("name", PROPERTIES)
def test_property(name, keep_row):
    outcome = run_property(name)
    keep_row(name, outcome)
    assert outcome.cases and not outcome.failures


def test_a_splat_that_is_not_a_number_is_named_and_changes_no_picture():
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        g = random_splats(60, 14)
        without = g.select(torch.arange(60) != 7)
        getattr(g, name)[7] = math.nan
        with pytest.raises(ValueError, match=f"splat 7 has nan in {name}"):
            g.validate()
        assert torch.equal(*(rasterize(ahead(x), SMALL).rgb for x in (g, without))), name
