import pytest
import torch

from recon.fit.losses import EVERYWHERE, STEP, PictureLoss, _blur, _blur_back, _blur_back_by_matrices, _blur_by_matrices, similarity
from render.compare import ssim

ON_A_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")


def pictures(height, width, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.rand(height, width, 3, generator=generator, dtype=dtype) for _ in range(2))
    return a, (b + 2 * a) / 3


LATTICES = [EVERYWHERE, (3, 0, 0), (3, 1, 2), (3, 2, 1)]


@pytest.mark.parametrize("lattice", LATTICES)
def test_its_gradient_is_the_finite_difference(lattice):
    a, b = pictures(14, 17)
    a.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: PictureLoss.apply(x, b, 0.2, lattice), a)


def test_similarity_is_the_reported_metrics():
    # the borders differ: zeros here, reflection there
    a, b = pictures(120, 160, torch.float32)
    assert abs(float(similarity(a, b)[0]) - ssim(a, b)) < 0.01


def test_all_lattices_together_see_as_much_of_every_pixel():
    a, b = pictures(90, 120)
    mean = sum(similarity(a, b, (STEP, row, column))[1] for row in range(STEP) for column in range(STEP)) / STEP**2
    inner = (slice(12, -12), slice(12, -12))  # at the last rows and columns lattices end sooner
    whole = similarity(a, b)[1]
    torch.testing.assert_close(mean[inner] * mean.numel(), whole[inner] * whole.numel(), rtol=0.03, atol=0.003)


@pytest.mark.parametrize("lattice", LATTICES)
def test_matrices_blur_as_windows_do(lattice):
    maps = torch.cat(pictures(23, 41, torch.float32), -1)
    small = _blur(maps, lattice)
    torch.testing.assert_close(_blur_by_matrices(maps, lattice), small, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(_blur_back_by_matrices(small, lattice, 23, 41), _blur_back(small, lattice, 23, 41), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("height", range(16, 22))
def test_what_it_says_of_pixels_is_what_pixels_said_of_it(height):
    for lattice in ((STEP, row, column) for row in range(STEP) for column in range(STEP)):
        maps = torch.cat(pictures(height, 37, torch.float32), -1)
        small = _blur(maps, lattice)
        said = torch.rand(small.shape, generator=torch.Generator().manual_seed(1))
        there, back = (small * said).double().sum(), (maps * _blur_back(said, lattice, height, 37)).double().sum()
        torch.testing.assert_close(there, back, rtol=1e-5, atol=0)


@ON_A_GPU
@pytest.mark.parametrize("lattice", LATTICES)
def test_a_gpu_finds_the_same(lattice):
    a, b = pictures(40, 61, torch.float32)
    for here, there in zip(similarity(a, b, lattice), similarity(a.cuda(), b.cuda(), lattice), strict=True):
        torch.testing.assert_close(there.cpu(), here, atol=1e-5, rtol=1e-4)


def test_equal_pictures_lose_nothing():
    a, _ = pictures(20, 20, torch.float32)
    assert float(PictureLoss.apply(a, a, 0.2, EVERYWHERE)) == pytest.approx(0, abs=1e-6)
