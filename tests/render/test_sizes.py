"""Pictures of other sizes than the splats were fitted to show the same: what a pixel added to a splat there is as large a part of it."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from randomized import gaussians

from render import render_frame
from render.compare import psnr
from scenes import Scene, SplatModel, load
from scenes.lenses import Pinhole
from scenes.orbit import around

BUNDLED = Path(__file__).parents[2] / "examples" / "data" / "drive002"


@pytest.fixture(scope="module")
def drive() -> Scene:
    return load(BUNDLED)


@pytest.fixture(scope="module")
def camera(drive):
    return drive.camera("front_camera", int(drive.frame_times("front_camera")[40]))


@pytest.fixture(scope="module")
def unaware(drive):
    """The same, of which nobody knows what it was fitted to."""
    return replace(drive, rig={name: replace(c, fitted=False) for name, c in drive.rig.items()})


def shown(scene: Scene, camera, size: tuple[int, int]) -> torch.Tensor:
    return render_frame(scene, camera.resized(*size)).rgb.clamp(0, 1)


@pytest.mark.parametrize(("shrink", "least", "at_most_plain"), [(2, 32, 28), (4, 31, 25), (8, 29, 23)])
def test_a_smaller_picture_is_what_the_fitted_one_shows_in_each_of_its_pixels(drive, unaware, camera, shrink, least, at_most_plain):
    """Against the mean of the fitted size's pixels; splats widened by as many pixels as there are far from it."""
    width, height = camera.width // shrink, camera.height // shrink
    whole = shown(drive, camera, (camera.width, camera.height))
    mean = torch.nn.functional.adaptive_avg_pool2d(whole.permute(2, 0, 1)[None], (height, width))[0].permute(1, 2, 0)
    assert psnr(shown(drive, camera, (width, height)), mean) > least
    assert psnr(shown(unaware, camera, (width, height)), mean) < at_most_plain


def test_a_larger_picture_has_no_gaps_between_splats(drive, unaware, camera):
    """Three times as large, its pixels' means are the fitted picture, whose splats reached as far into each other."""
    whole = shown(drive, camera, (camera.width, camera.height))
    large = shown(drive, camera, (3 * camera.width, 3 * camera.height))
    mean = torch.nn.functional.avg_pool2d(large.permute(2, 0, 1)[None], 3)[0].permute(1, 2, 0)
    thin = torch.nn.functional.avg_pool2d(shown(unaware, camera, (3 * camera.width, 3 * camera.height)).permute(2, 0, 1)[None], 3)[0]
    assert psnr(mean, whole) > psnr(thin.permute(1, 2, 0), whole) + 3


def test_the_fitted_size_is_drawn_as_trained(drive, camera):
    assert drive.model_for(camera) is drive.model
    assert drive.model_for(camera.resized(camera.width // 2, camera.height // 2).resized(camera.width, camera.height)) == drive.model


def test_each_camera_of_a_rig_has_its_own_size(drive):
    side = drive.rig["front_left_camera"]
    rig = drive.rig | {"front_left_camera": side.resized(2 * side.width, 2 * side.height)}
    uneven = replace(drive, rig=rig)
    for name in uneven.rig:
        camera = uneven.camera(name, int(drive.frame_times(name)[10]))
        assert uneven.model_for(camera) == drive.model, name
        assert uneven.model_for(camera.resized(camera.width // 2, camera.height // 2)).dilation == pytest.approx(0.3 / 4), name


def test_of_a_file_of_splats_nobody_knows_what_they_were_fitted_to():
    scene = around(gaussians(50, seed=1), "splats.ply")
    camera = scene.camera("orbit", 0)
    assert scene.model_for(camera.resized(96, 54)) == SplatModel()


def test_splats_trained_with_compensation_are_drawn_so_at_any_size(drive, camera):
    mip = replace(drive, model=SplatModel(antialias=True))
    assert mip.model_for(camera.resized(64, 36)) == mip.model


def test_a_camera_of_nobodys_is_as_that_of_the_rig_that_sees_as_wide_an_angle(drive, camera):
    focal = max(camera.lens.focal())
    own = replace(camera, lens=Pinhole(focal / 4, focal / 4, 80, 45), width=160, height=90)
    assert drive.model_for(own).dilation == pytest.approx(0.3 / 16)
    assert drive.model_for(own).smoothing == pytest.approx(0.1 * 15 / 16)


def test_a_larger_picture_of_another_angle_is_drawn_as_trained(drive, camera):
    """Of what a telephoto lens shows from afar other cameras were near."""
    focal = 3 * max(camera.lens.focal())
    assert drive.model_for(replace(camera, lens=Pinhole(focal, focal, 320, 180))) == drive.model
    small = replace(camera, lens=Pinhole(focal / 6, focal / 6, 53, 30), width=107, height=60)
    assert drive.model_for(small).dilation == pytest.approx(0.3 / 4)


def test_what_was_fitted_to_pictures_that_are_known_is_drawn_by_their_pixels_a_radian(drive, camera):
    """Up, too: of what a telephoto lens shows from the fitted camera's place nobody was nearer."""
    focal = max(camera.lens.focal())
    for scale in (1 / 4, 1, 3):
        own = replace(camera, lens=Pinhole(scale * focal, scale * focal, 320, 180), trained_focal=focal)
        assert drive.model_for(own) == drive.model.at_scale(scale)
        assert drive.model_for(own.resized(camera.width // 2, camera.height // 2)) == drive.model.at_scale(scale / 2)


def test_a_smoothing_below_none_is_refused():
    with pytest.raises(ValueError, match="smoothing must be at least 0 px.2 and finite"):
        SplatModel(smoothing=-0.1)
