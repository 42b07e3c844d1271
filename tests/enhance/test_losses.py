"""What training minimises."""

import numpy as np
import pytest
import torch

from enhance.autoencoder import Encoder
from enhance.losses import PatchPerceptual, pixel_loss, region_loss, temporal_loss, where_loss


def test_pixel_loss_is_least_at_the_target_and_counts_small_regions_fully():
    target, region = torch.rand(2, 3, 32, 32), torch.zeros(2, 1, 32, 32)
    region[:, :, :6, :6] = 1
    right = pixel_loss(target, target, region)
    inside = pixel_loss(target + 0.1 * region, target, region)
    outside = pixel_loss(target + 0.1 * (1 - region), target, region)
    assert right < outside < inside


def test_pixel_loss_has_a_gradient_without_region():
    out = torch.rand(1, 3, 16, 16, requires_grad=True)
    pixel_loss(out, torch.zeros(1, 3, 16, 16), torch.zeros(1, 1, 16, 16)).backward()
    assert out.grad is not None and torch.isfinite(out.grad).all() and out.grad.abs().sum() > 0


def test_where_loss_opens_the_gate_in_the_region_and_closes_it_elsewhere():
    region = torch.zeros(1, 1, 32, 32)
    region[:, :, :6] = 1
    assert where_loss((2 * region - 1) * 8, region) < 0.1 < 8 < where_loss((1 - 2 * region) * 8, region)
    nowhere = torch.full_like(region, -8)
    assert where_loss(nowhere, region) > 7, "a small region counts fully"


def test_region_loss_counts_the_region_alone():
    target, region = torch.rand(1, 3, 32, 32), torch.zeros(1, 1, 32, 32)
    region[:, :, :16] = 1
    least = region_loss(target, target, region)
    assert region_loss(target + 0.1 * region, target, region) > least + 0.1
    assert region_loss(target + 0.1 * (1 - region), target, region) == least


def test_temporal_loss_is_zero_for_a_picture_that_moves_with_its_flow():
    picture = torch.rand(1, 3, 20, 24)
    flow = torch.zeros(1, 2, 20, 24)
    flow[:, 0] = 2
    now, seen = torch.roll(picture, -2, -1), torch.ones(1, 1, 20, 24)
    assert temporal_loss(now, picture, flow, seen) < 1e-6
    assert temporal_loss(now, picture, torch.zeros_like(flow), seen) > 0.1
    assert temporal_loss(now, picture, torch.zeros_like(flow), torch.zeros_like(seen)) == 0


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
