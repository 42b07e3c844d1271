"""What training draws."""

import numpy as np
import pytest
import torch

from enhance.samples import Photos, Sampler
from render.video import write_image
from render.warp import warp


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    for i in range(3):
        write_image(folder / f"{i}.png", torch.rand(90, 120, 3, generator=torch.Generator().manual_seed(i)))
    return folder


@pytest.fixture(scope="module")
def sampler(photos):
    return Sampler(None, Photos((photos,)), seed=1)


def test_a_sample_depends_on_seed_and_step_alone(photos, sampler):
    first, again, other = sampler.batch(5, 2, 1, 32), sampler.batch(5, 2, 1, 32), sampler.batch(6, 2, 1, 32)
    assert torch.equal(first.input, again.input) and not torch.equal(first.target, other.target)
    assert not torch.equal(first.target, Sampler(None, Photos((photos,)), seed=2).batch(5, 2, 1, 32).target)


def test_damage_stays_in_the_region_and_masks_are_whole_or_unknown(sampler):
    for step in range(12):
        s = sampler.batch(step, 4, 1, 32)
        outside = (s.region == 0).expand_as(s.input)
        assert (s.input - s.target).abs()[outside].max() <= 0.51 / 255  # inputs are rounded to bytes
        for mask in s.mask:
            assert torch.isnan(mask).all() or (mask.min() >= 0 and mask.max() < 255)


def test_masks_are_sometimes_told_and_sometimes_not(sampler):
    unknown = torch.cat([torch.isnan(sampler.batch(step, 4, 1, 32).mask).flatten(1).all(1) for step in range(10)])
    assert 0.2 < unknown.float().mean() < 0.8


def test_panned_photos_move_exactly_along_their_flow(sampler):
    s = sampler.batch(3, 6, 3, 48)
    for t in (1, 2):
        moved, inside = warp(s.target[:, t - 1], s.flow[:, t])
        whole = (s.flow[:, t] % 1 == 0).flatten(1).all(1)  # crops that were not shrunk move by whole pixels
        assert whole.any()
        error = ((s.target[:, t] - moved).abs() * inside)[whole]
        assert error.max() < 1e-5


def test_flipping_turns_the_flow_too():
    from enhance.samples import Sample, _flipped

    x = torch.arange(12.0).reshape(1, 1, 1, 12).repeat(2, 3, 4, 1)
    flow = torch.stack([torch.full((2, 4, 12), 2.0), torch.zeros(2, 4, 12)], 1)
    one = torch.ones(2, 1, 4, 12)
    sample = Sample(x, x, one, one, flow, one)
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


def test_crops_look_for_the_changed_place(tmp_path):
    from enhance.shards import PairSet, to_bytes, write_shard

    target = torch.full((2, 120, 200, 3), 0.5)
    region = torch.zeros(2, 120, 200)
    region[:, 100:104, 180:184] = 1
    tensors = {
        "input": to_bytes(target + 0.2 * region[..., None]), "target": to_bytes(target), "region": to_bytes(region),
        "instance": torch.zeros(2, 120, 200, dtype=torch.uint8), "flow": torch.zeros(2, 120, 200, 2, dtype=torch.float16),
        "visible": torch.ones(2, 120, 200, dtype=torch.uint8), "depth": torch.ones(2, 120, 200, dtype=torch.float16),
    }  # fmt: skip
    for name, instances in (("some", [1]), ("none", [])):
        meta = {"kind": "shadow", "split": "train", "instances": instances}
        write_shard(tmp_path / "shadow" / f"{name}.safetensors", tensors, meta)
    sampler = Sampler(PairSet(tmp_path), None, seed=0)
    assert [s.path.stem for s in sampler.shards["shadow"]] == ["some"]
    found = torch.cat([sampler.batch(i, 4, 1, 32, kind="shadow").region.flatten(1).amax(1) for i in range(8)])
    assert found.mean() > 0.6  # of crops anywhere a fifteenth
