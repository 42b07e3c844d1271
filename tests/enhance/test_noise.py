"""A sensor's noise, of objects put right."""

from dataclasses import replace

import pytest
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

from enhance.correcting.corrections import Correction, correct
from enhance.correcting.grain import Grain
from enhance.correcting.noise import denoised, variances
from enhance.correcting.objects import ObjectNet
from enhance.correcting.shade import KNOTS
from enhance.metrics import region_ssim
from render.compare import psnr
from tests.enhance.test_grain import RIGHT, altered, put_in

NOISE = 0.04
RGB, NOISY = (x.permute(2, 0, 1) for x in (RIGHT, altered(RIGHT, noise=NOISE)))
LIGHT = rgb_to_linear_rgb(RGB)
WHOLE = torch.ones(RIGHT.shape[:2], dtype=torch.bool)


def test_noise_is_told_from_fine_texture():
    left = torch.zeros_like(WHOLE)
    left[:, :70] = True
    right = ~left
    noisy, usual = variances(torch.where(left, NOISY, RGB), (left, right)) or (0, 0)
    assert 0.85 < (noisy - usual) / NOISE**2 < 1.3
    grey = RGB.mean(0).expand(3, -1, -1)  # however rough
    both = variances(grey, (left, right))
    assert both is not None and max(both) < 1e-9
    assert variances(RGB, (left, torch.zeros_like(left))) is None  # nothing tells
    assert variances(RGB[:, :6], (left[:6], right[:6])) is None
    assert variances(torch.ones_like(RGB), (left, right)) is None  # burnt out


def test_noise_goes_and_lines_stay():
    better = linear_rgb_to_rgb(denoised(rgb_to_linear_rgb(NOISY), NOISE**2).clamp(0, 1))
    assert psnr(better.permute(1, 2, 0), RIGHT) > psnr(NOISY.permute(1, 2, 0), RIGHT) + 4
    torch.testing.assert_close(denoised(LIGHT, 0.0), LIGHT, rtol=0, atol=1e-5)
    for side in (1, 3):  # smaller than a patch
        assert denoised(LIGHT[:, :side, :side], NOISE**2).shape == (3, side, side)


def test_dark_noise_in_other_colours_is_undone_as_the_camera_made_it():
    """Undone before colours, as if it were as strong in the dark as in the light, by what fine grey detail there was: 4.8 dB, SSIM 0.94."""
    given, ids = put_in(altered(RIGHT, noise=0.05))
    better = correct(ObjectNet(), given, ids, {})[0].permute(1, 2, 0)
    mask = ids > 0
    assert psnr(better, RIGHT, mask) > psnr(given.permute(1, 2, 0), RIGHT, mask) + 6.5
    assert region_ssim(better, RIGHT, mask) > 0.95


def test_noise_counts_from_twice_that_around_on_and_as_it_was_before_it_was_sharpened():
    """Sharpening multiplies its variance by a square."""
    sharp = Grain.of(altered(RIGHT, sharpen=1.2)), Grain.of(RIGHT)
    plain = Correction(torch.zeros(15), torch.zeros(KNOTS), None, torch.tensor([5e-4, 1e-4]).double(), 1)
    assert plain.excess() == (0.0, pytest.approx(5e-4 - 2e-4 - 2e-5))
    assert replace(plain, noise=torch.tensor([2.1e-4, 1e-4]).double()).excess() == (0.0, 0.0), "as right ones may have"
    sharpened, variance = replace(plain, grain=sharp).excess()
    assert 0.5 < sharpened < 1.5 and variance == pytest.approx(plain.excess()[1] / (1 + sharpened) ** 2)
