from functools import partial

import pytest
import torch
import torch.nn.functional as F

from recon.fit.develop import Develop, developed, developed_by_matrices
from recon.kernels.develop import SKY_STEP
from scenes import Camera, Pinhole
from scenes.poses import yaw
from scenes.sky import sample_equirect


def parts(height=21, width=37, seed=0):
    generator = torch.Generator().manual_seed(seed)
    rgb, alpha = torch.rand(3, height, width, generator=generator).permute(1, 2, 0), torch.rand(height, width, generator=generator)
    samples = torch.rand(height // SKY_STEP + 2, width // SKY_STEP + 2, 3, generator=generator)
    exposure = torch.eye(3, 4) + 0.1 * torch.randn(3, 4, generator=generator)
    return [t.requires_grad_() for t in (rgb, alpha, samples, exposure)]


def plainly(rgb, alpha, samples, exposure, shift):
    fine = F.interpolate(samples.permute(2, 0, 1)[None], scale_factor=SKY_STEP, mode="bilinear", align_corners=False)[0].permute(1, 2, 0)
    behind = fine[shift[0] : shift[0] + rgb.shape[0], shift[1] : shift[1] + rgb.shape[1]]
    return (rgb + (1 - alpha)[..., None] * behind) @ exposure[:, :3].T + exposure[:, 3]


@pytest.mark.parametrize("way", [Develop.apply, developed_by_matrices])
def test_it_is_the_sum_that_torch_computes_and_so_are_its_gradients(way):
    for shift in ((0, 0), (7, 7), (3, 5)):
        ours, theirs = parts(), parts()
        weights = torch.rand(21, 37, 3, generator=torch.Generator().manual_seed(1))
        one, other = way(*ours, shift), plainly(*theirs, shift)
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)
        (one * weights).sum().backward()
        (other * weights).sum().backward()
        for a, b in zip(ours, theirs, strict=True):
            torch.testing.assert_close(a.grad, b.grad, atol=1e-5, rtol=1e-4)


def test_a_bare_picture_shows_the_sky_that_its_rays_meet():
    body_from_cam = torch.tensor([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
    camera = Camera(Pinhole(40.0, 40.0, 32.0, 24.0), 64, 48, yaw(0.3) @ body_from_cam)
    x = torch.linspace(0, 1, 64)[None, :, None]
    sky = (0.5 + 0.4 * torch.sin(6.28 * x) * torch.linspace(1, 0, 32)[:, None, None]).expand(32, 64, 3).contiguous()
    rays = camera.lens.unproject(camera.pixel_centres()) @ camera.world_from_cam[:3, :3].T
    nothing = torch.zeros(48, 64)
    shown = developed(nothing[..., None].expand(48, 64, 3), nothing, partial(sample_equirect, sky), torch.eye(3, 4), camera, (2, 6))
    torch.testing.assert_close(shown, sample_equirect(sky, rays), atol=0.02, rtol=0)
