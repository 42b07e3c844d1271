"""Colour settings in linear light."""

import numpy as np
import pytest
import torch

from enhance.pairs.isp import Isp, alter, random_isp, random_pipeline
from enhance.pairs.masks import random_mask


def image(seed=0, h=12, w=20):
    return torch.rand(3, h, w, generator=torch.Generator().manual_seed(seed))


def test_neutral_settings_change_nothing():
    x = image()
    assert torch.allclose(Isp()(x), x, atol=2e-6)


def test_one_stop_doubles_linear_light():
    from kornia.color import rgb_to_linear_rgb

    x = image() * 0.6  # nothing clips
    assert torch.allclose(rgb_to_linear_rgb(Isp(exposure=1)(x)), 2 * rgb_to_linear_rgb(x), atol=1e-5)


def test_settings_are_applied_as_a_camera_does():
    """Gains first, then saturation about the luma that they leave, the exponent, and the curve."""
    from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

    light = torch.tensor([0.30, 0.12, 0.05])
    isp = Isp(exposure=-0.4, red=0.3, blue=-0.5, saturation=1.1, gamma=1.2, tone=0.5)
    red, green, blue = 0.30 * 2**-0.1, 0.12 * 2**-0.4, 0.05 * 2**-0.9
    luma = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    curved = [(luma + 1.1 * (c - luma)) ** 1.2 for c in (red, green, blue)]
    wanted = [1.5 * c / (1 + 0.5 * c) for c in curved]
    found = rgb_to_linear_rgb(isp(linear_rgb_to_rgb(light[:, None, None].expand(3, 2, 2))))
    assert found[:, 0, 0].tolist() == pytest.approx(wanted, rel=1e-4)


def test_no_saturation_is_grey():
    y = Isp(saturation=0)(image())
    assert torch.allclose(y, y.mean(0, keepdim=True).expand_as(y), atol=1e-6)


def test_pixels_outside_the_mask_are_exact():
    x, mask = image(), torch.zeros(1, 12, 20)
    mask[:, 3:7, 4:9] = 0.5
    y = alter(x, mask, Isp(exposure=-1, red=0.4))
    outside = (mask == 0).expand_as(x)
    assert torch.equal(y[outside], x[outside]) and not torch.equal(y, x)
    torch.testing.assert_close(y[~outside], (x + Isp(exposure=-1, red=0.4)(x))[~outside] / 2, atol=1e-6, rtol=0)


def test_noise_has_the_spread_that_was_asked_for():
    from kornia.color import rgb_to_linear_rgb

    grey = torch.full((3, 200, 200), 0.6)
    light = rgb_to_linear_rgb(grey)
    y = rgb_to_linear_rgb(Isp(noise=0.02, seed=3)(grey)) - light
    assert abs(float(y.std() / (0.02 * (light.mean() + 0.02).sqrt())) - 1) < 0.02 and abs(float(y.mean())) < 1e-3
    assert torch.equal(Isp(noise=0.02, seed=3)(grey), Isp(noise=0.02, seed=3)(grey))
    assert not torch.equal(Isp(noise=0.02, seed=3)(grey), Isp(noise=0.02, seed=4)(grey))


def test_sharpening_leaves_what_is_even_and_overshoots_at_edges():
    x = torch.full((3, 16, 16), 0.4)
    assert torch.allclose(Isp(sharpen=1.0)(x), x, atol=2e-6)
    x[..., 8:] = 0.6
    y = Isp(sharpen=1.0)(x)
    assert y[..., 7].max() < 0.39 and y[..., 8].min() > 0.61 and torch.allclose(y[..., :4], x[..., :4], atol=2e-6)


def test_results_stay_in_range():
    rng = np.random.default_rng(3)
    for draw in (random_isp, random_pipeline) * 25:
        y = draw(rng)(image())
        assert torch.isfinite(y).all() and y.min() >= 0 and y.max() <= 1


def test_random_settings_follow_the_seed():
    for draw in (random_isp, random_pipeline):
        assert draw(np.random.default_rng(4)) == draw(np.random.default_rng(4)) != draw(np.random.default_rng(5))


@pytest.mark.parametrize(
    "wrong", [{"gamma": 0}, {"saturation": -1}, {"tone": -1}, {"noise": -1}, {"sharpen": -1}, {"exposure": float("nan")}]
)
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
