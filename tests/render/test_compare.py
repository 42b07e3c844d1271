import math

import pytest
import torch

from render.compare import psnr, ssim


def test_psnr_of_a_constant_error_is_its_definition():
    a = torch.full((4, 5, 3), 0.5)
    assert psnr(a, a + 0.1) == pytest.approx(20, abs=1e-4)  # 0.6 and 0.1 in float32


def test_equal_images_have_no_error():
    a = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
    assert psnr(a, a) == math.inf
    assert ssim(a, a) == pytest.approx(1, abs=1e-6)


def test_a_mask_leaves_the_rest_out():
    a, b = torch.zeros(2, 2, 3), torch.zeros(2, 2, 3)
    b[0, 0], b[1, 1] = 0.1, 1.0
    mask = torch.tensor([[True, False], [False, False]])
    assert psnr(a, b, mask) == pytest.approx(20, abs=1e-4)


def test_ssim_of_a_mask_is_that_of_its_pixels():
    a = torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(0))
    b, mask = a.clone(), torch.zeros(40, 40, dtype=torch.bool)
    b[:, 20:] = 1 - a[:, 20:]
    mask[:, :20] = True
    assert ssim(a, b, mask) == pytest.approx(1.0) and ssim(a, b, ~mask) < -0.5 < ssim(a, b) < 0.5


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_an_empty_mask_is_refused(metric):
    with pytest.raises(ValueError, match="no pixel"):
        metric(torch.zeros(12, 12, 3), torch.zeros(12, 12, 3), torch.zeros(12, 12, dtype=torch.bool))


def test_images_of_different_sizes_are_refused():
    with pytest.raises(ValueError, match=r"second image must have shape \(2, 2, 3\), got \(2, 3, 3\)"):
        psnr(torch.zeros(2, 2, 3), torch.zeros(2, 3, 3))


def test_noise_lowers_ssim_more_than_a_shift_of_brightness():
    generator = torch.Generator().manual_seed(0)
    a = torch.rand(32, 32, 3, generator=generator) * 0.5 + 0.2
    noisy = a + 0.05 * torch.randn(32, 32, 3, generator=generator)
    assert ssim(a, noisy) < ssim(a, a + 0.05) < 1


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_bytes_are_refused_and_not_compared_as_if_they_were_white(metric):
    with pytest.raises(ValueError, match="the second image must be floats in 0..1, got torch.uint8"):
        metric(torch.zeros(12, 12, 3), torch.zeros(12, 12, 3, dtype=torch.uint8))
