"""The sky that is laid behind a picture is the one that gradients flow through."""

from dataclasses import replace

import pytest
import torch

from render.sky import SKY_SHOWS, over_sky
from scenes import Camera, Equirectangular, Fisheye, Pinhole, Sky
from scenes.poses import pose_from

POSE = pose_from([0.9, 0.2, -0.5, 0.1], [0.0, 0.0, 1.0])
CAMERAS = {
    "pinhole": Camera(Pinhole(30.0, 31.0, 20.0, 15.0), 41, 30, POSE),
    "all around, the seam and both poles": Camera(Equirectangular.whole(64, 32), 64, 32, POSE),
    "fisheye, with pixels that no ray leads to": Camera(Fisheye(9.0, 9.0, 20.0, 20.0), 40, 40, POSE),
    "by rows": Camera(
        Pinhole(30.0, 31.0, 20.0, 15.0), 41, 30, POSE, shutter="rows", world_from_cam_end=pose_from([1.0, 0.1, 0, 0], [1.0, 0, 1])
    ),
    "by columns": Camera(
        Pinhole(30.0, 31.0, 20.0, 15.0), 41, 30, POSE, shutter="columns", world_from_cam_end=pose_from([1.0, 0.1, 0, 0], [0.0] * 3)
    ),
}


def picture(camera: Camera) -> tuple[torch.Tensor, torch.Tensor, Sky]:
    dice = torch.Generator().manual_seed(6)
    alpha = torch.rand(camera.height, camera.width, generator=dice).round(decimals=1)
    rgb = torch.rand(3, camera.height, camera.width + 5, generator=dice)[:, :, : camera.width].permute(1, 2, 0)  # strided, as frames are
    return rgb * alpha[..., None], alpha, Sky(torch.rand(9, 17, 3, generator=dice))


@pytest.mark.parametrize("name", CAMERAS)
def test_both_ways_give_the_same_picture(name):
    rgb, alpha, sky = picture(CAMERAS[name])
    laid = over_sky(rgb, alpha, sky, CAMERAS[name])
    followed = over_sky(rgb, alpha, replace(sky, linear=sky.linear.clone().requires_grad_()), CAMERAS[name]).detach()
    assert (laid - followed).abs().max() < 2e-5
    assert (laid - rgb)[alpha == 1].abs().max() == 0 and (laid - rgb)[alpha == 0].abs().max() > 0.1


def test_a_sky_that_changed_is_not_the_one_that_was_kept():
    camera = CAMERAS["pinhole"]
    rgb, alpha, sky = picture(camera)
    before = over_sky(rgb, alpha, sky, camera)
    sky.linear.mul_(0.5)
    assert (over_sky(rgb, alpha, sky, camera) - before).abs().max() > 0.05


def test_a_picture_that_hides_the_sky_is_left_as_it_is():
    camera = CAMERAS["pinhole"]
    rgb, alpha, sky = picture(camera)
    assert over_sky(rgb, torch.full_like(alpha, 1 - SKY_SHOWS / 2), sky, camera) is rgb
