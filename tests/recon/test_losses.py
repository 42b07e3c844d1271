import pytest
import torch

from recon.fit.losses import PictureLoss, _blur, _blur_by_matrices, similarity
from render.compare import ssim


def pictures(height, width, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.rand(height, width, 3, generator=generator, dtype=dtype) for _ in range(2))
    return a, (b + 2 * a) / 3


def test_its_gradient_is_the_finite_difference():
    a, b = pictures(14, 17)
    a.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: PictureLoss.apply(x, b, 0.2, (2, 3, 11, 12)), a)


def test_similarity_is_the_reported_metrics():
    # the borders differ: zeros here, reflection there
    a, b = pictures(120, 160, torch.float32)
    assert abs(float(similarity(a, b)[0]) - ssim(a, b)) < 0.01


def test_matrices_blur_as_windows_do():
    maps = torch.cat(pictures(23, 41, torch.float32), -1)
    torch.testing.assert_close(_blur_by_matrices(maps), _blur(maps), atol=1e-6, rtol=1e-5)


def test_equal_pictures_lose_nothing():
    a, _ = pictures(20, 20, torch.float32)
    assert float(PictureLoss.apply(a, a, 0.2, (0, 0, 20, 20))) == pytest.approx(0, abs=1e-6)
