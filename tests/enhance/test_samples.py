"""What training draws."""

import mmap

import numpy as np
import pytest
import torch
from PIL import Image

from enhance.pairs.shards import PairSet, to_bytes, write_shard
from enhance.photos import Photos
from enhance.training.samples import Sampler
from render.video import write_image


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    for i in range(3):
        write_image(folder / f"{i}.png", torch.rand(90, 120, 3, generator=torch.Generator().manual_seed(i)))
    return folder


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    """A rendered clip that is off by 0.1, with photos that are right on its left half, and one whose photos say nothing."""
    folder = tmp_path_factory.mktemp("pairs")
    target = torch.rand(4, 60, 80, 3, generator=torch.Generator().manual_seed(0)) * 0.6 + 0.2
    trust = torch.zeros(4, 60, 80)
    trust[..., :40] = 1
    for kind, trusted in (("sparse", trust), ("underfit", torch.zeros_like(trust))):
        tensors = {
            "input": to_bytes(target + 0.1), "target": to_bytes(target), "region": to_bytes(torch.ones_like(trust)),
            "instance": torch.ones(4, 60, 80, dtype=torch.uint8), "flow": torch.zeros(4, 60, 80, 2, dtype=torch.float16),
            "visible": torch.ones(4, 60, 80, dtype=torch.uint8), "depth": torch.ones(4, 60, 80, dtype=torch.float16),
            "reference": to_bytes(target), "trust": to_bytes(trusted),
        }  # fmt: skip
        for split in ("train", "held out"):
            write_shard(folder / kind / f"{split}.safetensors", tensors, {"kind": kind, "split": split})
    return PairSet(folder)


@pytest.fixture(scope="module")
def sampler(pairs):
    return Sampler(pairs, None, seed=1)


def test_a_sample_depends_on_seed_and_step_alone(pairs, sampler):
    first, again, other = sampler.batch(5, 2, 1, 32), sampler.batch(5, 2, 1, 32), sampler.batch(6, 2, 1, 32)
    assert torch.equal(first.input, again.input) and not torch.equal(first.target, other.target)
    assert not torch.equal(first.target, Sampler(pairs, None, seed=2).batch(5, 2, 1, 32).target)


def test_photos_are_laid_in_where_they_are_trusted_half_of_the_time(sampler):
    seen = 0
    for step in range(40):
        s = sampler.batch(step, 4, 2, 32)
        trusted = s.trust.expand_as(s.input) > 0
        assert (s.input - s.target)[trusted].abs().amax() <= 0.51 / 255 if trusted.any() else True
        assert (s.input - s.target)[~trusted].abs().median() > 0.01
        assert (s.reference[~trusted] == 0).all()
        seen += int((s.trust.flatten(1).amax(1) > 0).sum())
    assert 10 < seen < 70  # of 160; half of the clips have photos, half of those are told, and some crops lie beside


def test_masks_are_sometimes_told_and_sometimes_not(sampler):
    unknown = torch.cat([torch.isnan(sampler.batch(step, 4, 1, 32).mask).flatten(1).all(1) for step in range(10)])
    assert 0.2 < unknown.float().mean() < 0.8


def test_right_pictures_come_from_pairs_and_photos(pairs, photos):
    assert Sampler(None, Photos((photos,)), seed=1).right(0, 3, 32).rgb.shape == (3, 3, 32, 32)
    assert Sampler(pairs, Photos((photos,)), seed=1).images(0, 6, 32).rgb.shape == (6, 3, 32, 32)
    assert not Sampler(None, Photos((photos,)), seed=1).rendered


def test_photos_to_train_on_stay_on_the_disk_as_they_are(tmp_path):
    rng = np.random.default_rng(0)
    made = [rng.integers(0, 256, (*size, 3), np.uint8) for size in ((20, 30), (40, 24), (17, 16))]
    for i, photo in enumerate(made):
        Image.fromarray(photo).save(tmp_path / f"{i}.png")
    frames = Photos((tmp_path,)).frames
    assert all(np.array_equal(frame, photo) for frame, photo in zip(frames, made, strict=True))
    base = frames[0]
    while isinstance(base.base, np.ndarray):
        base = base.base
    assert isinstance(base.base, mmap.mmap) and sum(map(np.size, frames)) == base.size


def test_what_is_held_out_is_not_drawn(sampler):
    assert {str(s.meta["split"]) for kind in ("sparse", "underfit") for s in sampler.shards[kind]} == {"train"}


def test_beyond_a_clip_that_is_smaller_than_a_crop_nothing_is_known(sampler):
    """What is repeated there moves nowhere."""
    for step in range(4):
        s = sampler.batch(step, 1, 2, 96)  # of 60 x 80
        assert torch.isnan(s.flow[..., 60:, :]).all() and not s.visible[..., 60:, :].any() and not (s.mask[..., 60:, :] > 0).any()
        assert torch.isfinite(s.flow[:, 1, :, :60, 16:80]).all() and torch.isfinite(s.input).all()


def test_flipping_turns_the_flow_too():
    from enhance.training.samples import Sample, _flipped

    x = torch.arange(12.0).reshape(1, 1, 1, 12).repeat(2, 3, 4, 1)
    flow = torch.stack([torch.full((2, 4, 12), 2.0), torch.zeros(2, 4, 12)], 1)
    one = torch.ones(2, 1, 4, 12)
    sample = Sample(x, x, one, flow, one, x, one)
    turned = [_flipped(np.random.default_rng(i), sample) for i in range(12)]
    for t in turned:
        mirrored = t.input[0, 0, 0, 0] == 11
        assert (t.flow[:, 0] == (-2 if mirrored else 2)).all()
    assert len({float(t.input[0, 0, 0, 0]) for t in turned}) == 2


def test_nothing_to_train_on_is_refused(tmp_path):
    with pytest.raises(ValueError, match="nothing to train on"):
        Sampler(None, None, 0)
    with pytest.raises(ValueError, match="holds no photos"):
        Photos((tmp_path,))
