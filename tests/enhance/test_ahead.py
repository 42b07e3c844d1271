"""Samples drawn ahead by other processes."""

from itertools import islice

import pytest
import torch

from enhance.batch import Batch
from enhance.photos import Photos
from enhance.training.ahead import drawn
from enhance.training.samples import Sampler
from render.video import write_image

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def sampler(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    write_image(folder / "0.png", torch.rand(90, 120, 3, generator=torch.Generator().manual_seed(0)))
    return Sampler(None, Photos((folder,)), seed=1)


def tensors(batch: Batch) -> list[torch.Tensor]:
    found: list[torch.Tensor] = []
    batch.each(lambda x: found.append(x) or x)
    return found


def draws_of(sampler, what):
    return {"right": lambda step: sampler.right(step, 2, 32), "objects": lambda step: sampler.objects(step, 3)}[what]


@pytest.mark.parametrize("what", ["right", "objects"])
def test_what_is_drawn_ahead_is_what_is_drawn_when_asked_for(sampler, what):
    state = torch.get_rng_state()
    asked, ahead = (islice(drawn(draws_of(sampler, what), 5, CPU, processes), 4) for processes in (0, 2))
    for one, other in zip(asked, ahead, strict=True):
        assert len(tensors(one)) == {"right": 1, "objects": 9}[what]
        assert all(torch.equal(a.nan_to_num(7), b.nan_to_num(7)) for a, b in zip(tensors(one), tensors(other), strict=True))
    assert torch.equal(state, torch.get_rng_state())


def test_nothing_may_be_drawn():
    assert list(islice(drawn(lambda step: None, 0, CPU, 0), 2)) == [None, None]


def test_an_error_in_another_process_is_told():
    def fail(step):
        raise ValueError("the pairs are gone")

    with pytest.raises(ValueError, match="the pairs are gone"):
        next(drawn(fail, 0, CPU, 1))
