"""What training minimises."""

import numpy as np
import pytest
import torch
from small_net import SMALL

from enhance.network.autoencoder import Encoder
from enhance.network.net import Net
from enhance.training.losses import PatchPerceptual, flicker, pixel_loss
from enhance.training.run import TrainConfig
from enhance.training.samples import Sample
from enhance.training.stages import rollout_losses


def test_pixel_loss_is_least_at_the_target_and_slight_damage_counts_beside_strong():
    target = torch.rand(2, 3, 32, 32)
    right, off = pixel_loss(target, target, 0.02), pixel_loss(target + 0.1, target, 0.02)
    assert right < off < pixel_loss(target + 0.2, target, 0.02)
    slight = torch.stack([target[0], target[1] + 0.02])
    strong = torch.stack([target[0] + 0.2, target[1] + 0.02])
    better = torch.stack([target[0] + 0.2, target[1]])
    gained = [float(pixel_loss(a, target, 0.1) - pixel_loss(b, target, 0.1)) for a, b in ((slight, target), (strong, better))]
    assert abs(gained[0] - gained[1]) < 1e-5 and gained[0] > 2 * float(pixel_loss(slight, target, 0.0))


def test_flicker_is_what_the_target_has_not():
    picture, flow, seen = torch.rand(1, 3, 20, 24), torch.zeros(1, 2, 20, 24), torch.ones(1, 1, 20, 24)
    flow[:, 0] = 2
    now = torch.roll(picture, -2, -1)
    still = torch.zeros_like(flow)
    assert flicker(now, picture, now, picture, flow, seen) < 1e-6
    assert flicker(now, picture, torch.zeros_like(now), torch.zeros_like(now), flow, seen) < 1e-6
    assert flicker(now, picture, torch.zeros_like(now), torch.zeros_like(now), still, seen) > 0.1
    assert flicker(now, picture, now, picture, still, seen) < 1e-6, "the target changes just so"
    assert flicker(now, picture, now, now, still, torch.zeros_like(seen)) == 0


def test_a_clip_that_changes_as_its_target_does_costs_no_flicker():
    clip, some = torch.rand(1, 3, 3, 32, 32), torch.zeros(1, 3, 1, 32, 32)
    sample = Sample(clip, clip, some, torch.zeros(1, 3, 2, 32, 32), some + 1, torch.zeros_like(clip), some)
    net, costs = Net(SMALL), []
    for temporal in (0.0, 1.0):
        config = TrainConfig(crop=32, frames=3, temporal=temporal)
        costs.append([float(cost.detach()) for cost in rollout_losses(net, sample, lambda *_: 0.0, config, np.random.default_rng(0))])
    assert len(costs[0]) == 3 and costs[0] == costs[1]


@pytest.mark.parametrize("size", [(32, 48), (64, 64)])
def test_perceptual_distance_is_zero_only_at_the_target(size):
    torch.manual_seed(0)
    distance, target = PatchPerceptual(Encoder()), torch.rand(1, 3, *size)
    rng = np.random.default_rng(0)
    assert distance(target, target, rng) == 0
    assert distance((target + 0.2 * torch.rand_like(target)).clamp(0, 1), target, rng) > 0


def test_a_local_vgg_file_is_used_and_a_wrong_one_refused(tmp_path):
    widths = [(3, 64), (64, 64), (64, 128), (128, 128), (128, 256), (256, 256), (256, 256), (256, 512), (512, 512), (512, 512)]
    places = [0, 2, 5, 7, 10, 12, 14, 17, 19, 21]
    state = {}
    for place, (a, b) in zip(places, widths, strict=True):
        state[f"features.{place}.weight"], state[f"features.{place}.bias"] = torch.randn(b, a, 3, 3) / (3 * a**0.5), torch.zeros(b)
    torch.save(state, tmp_path / "vgg16.pth")
    distance, target = PatchPerceptual(Encoder(), tmp_path / "vgg16.pth"), torch.rand(1, 3, 32, 32)
    assert distance(target, target, np.random.default_rng(0)) == 0 < distance(1 - target, target, np.random.default_rng(0))
    del state["features.5.bias"]
    torch.save(state, tmp_path / "vgg16.pth")
    with pytest.raises(ValueError, match="features.5.bias"):
        PatchPerceptual(Encoder(), tmp_path / "vgg16.pth")
