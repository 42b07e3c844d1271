"""Colour settings in linear light."""

import numpy as np
import pytest
import torch

from enhance.isp import Isp, alter, random_isp
from enhance.masks import random_mask


def image(seed=0, h=12, w=20):
    return torch.rand(3, h, w, generator=torch.Generator().manual_seed(seed))


def test_neutral_settings_change_nothing():
    x = image()
    assert torch.allclose(Isp()(x), x, atol=2e-6)


def test_one_stop_doubles_linear_light():
    from kornia.color import rgb_to_linear_rgb

    x = image() * 0.6  # nothing clips
    assert torch.allclose(rgb_to_linear_rgb(Isp(exposure=1)(x)), 2 * rgb_to_linear_rgb(x), atol=1e-5)


def test_no_saturation_is_grey():
    y = Isp(saturation=0)(image())
    assert torch.allclose(y, y.mean(0, keepdim=True).expand_as(y), atol=1e-6)


def test_pixels_outside_the_mask_are_exact():
    x, mask = image(), torch.zeros(1, 12, 20)
    mask[:, 3:7, 4:9] = 0.5
    y = alter(x, mask, Isp(exposure=-1, red=0.4))
    outside = (mask == 0).expand_as(x)
    assert torch.equal(y[outside], x[outside]) and not torch.equal(y, x)


def test_results_stay_in_range():
    rng = np.random.default_rng(3)
    for _ in range(50):
        y = random_isp(rng)(image())
        assert torch.isfinite(y).all() and y.min() >= 0 and y.max() <= 1


def test_random_settings_follow_the_seed():
    assert random_isp(np.random.default_rng(4)) == random_isp(np.random.default_rng(4)) != random_isp(np.random.default_rng(5))


@pytest.mark.parametrize("wrong", [{"gamma": 0}, {"saturation": -1}, {"tone": -1}, {"exposure": float("nan")}])
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Isp(**wrong)


def test_random_masks_lie_between_nothing_and_all():
    rng = np.random.default_rng(0)
    areas = []
    for _ in range(40):
        mask = random_mask(rng, 48, 64)
        assert mask.shape == (48, 64) and mask.dtype == np.float32 and mask.min() >= 0 and mask.max() <= 1.0001
        areas.append(mask.mean())
    assert 0.02 < np.mean(areas) < 0.4
