"""What of a fisheye's pictures lies beyond its circle, and that nothing does of others, however dark their corners are."""

from pathlib import Path

import numpy as np
import pytest
import torch

from recon.log import Log, LogCamera
from recon.views.egomask import with_ego_masks
from recon.views.frames import load_frames
from recon.views.image_circle import image_circle
from render.rays import camera_rays
from scenes.lenses import Fisheye, Pinhole
from scenes.poses import CAM_FROM_FLU, inverse, translation
from scenes.trajectory import Trajectory

SIZE = W, H = 160, 120
EDGE = 95.0
"""Degrees from the axis."""


@pytest.fixture
def camera() -> LogCamera:
    """190 degrees from side to side, so that the corners are beyond; 20 frames, a metre apart."""
    focal = W / np.radians(190.0)
    poses = torch.stack([translation(float(i)) @ inverse(CAM_FROM_FLU) for i in range(20)])
    return LogCamera("around", Fisheye(focal, focal, W / 2 + 3, H / 2), *SIZE, (Path("none"),) * 20, 100_000 * torch.arange(20), poses)


def degrees(camera: LogCamera) -> np.ndarray:
    rays = camera_rays(camera.camera(0))
    return torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2]).rad2deg().numpy()


def picture(camera: LogCamera, i: int, edge: float = EDGE, noise: int = 8) -> np.ndarray:
    """Whatever the street is like, of every level, within a circle; noise beyond."""
    chance = np.random.default_rng(i)
    levels = chance.integers(0, 256, (H, W, 3), dtype=np.uint8)
    beyond = degrees(camera) > edge
    levels[beyond] = chance.integers(0, noise, (int(beyond.sum()), 3))
    return levels


def found(camera: LogCamera, show) -> np.ndarray | None:
    return image_circle(camera, range(len(camera)), show)


def test_what_is_black_beyond_a_circle_is_no_street(camera):
    mask, beyond = found(camera, lambda i: picture(camera, i)), degrees(camera) > EDGE
    assert mask is not None and mask[beyond].all()
    assert not mask[degrees(camera) < 0.97 * EDGE].any(), "a rim of three hundredths at most"
    assert found(camera, lambda i: picture(camera, i, edge=180.0)) is None


def test_one_pixel_in_a_hundred_may_flare(camera):
    flares = np.random.default_rng(0).random((H, W)) < 0.01
    assert found(camera, lambda i: np.where(flares[..., None], 255, picture(camera, i)).astype(np.uint8)) is not None


def test_corners_that_are_dark_by_and_by_are_a_nights(camera):
    falls = np.clip(1.2 - degrees(camera) / 90, 0, 1)[..., None] ** 2
    assert found(camera, lambda i: (picture(camera, i, edge=180.0) * falls).astype(np.uint8)) is None


def test_a_black_sky_and_a_black_bonnet_are_no_rim(camera):
    def show(i: int) -> np.ndarray:
        night = picture(camera, i, edge=180.0)
        night[: H // 3] = night[-H // 6 :] = 3
        return night

    assert found(camera, show) is None
    assert found(camera, lambda i: np.zeros((H, W, 3), np.uint8)) is None


def test_a_pinhole_camera_may_look_through_a_tube():
    poses = torch.stack([translation(float(i)) @ inverse(CAM_FROM_FLU) for i in range(5)])
    camera = LogCamera("tube", Pinhole(80.0, 80.0, W / 2, H / 2), *SIZE, (Path("none"),) * 5, torch.arange(5), poses)
    mask = found(camera, lambda i: picture(camera, i, edge=40.0))
    assert mask is not None and mask[degrees(camera) > 40].all() and not mask[degrees(camera) < 38].any()


def test_a_fit_and_features_leave_it_out_and_say_so(camera, monkeypatch, capsys):
    monkeypatch.setattr(LogCamera, "image", lambda self, i, *size: picture(self, i))
    ego = Trajectory(camera.times_us, torch.stack([translation(float(i)) for i in range(20)]))
    log = Log("around", Path("around"), {"around": camera}, (), (), ego, {}, ("around",))
    view = load_frames(log, ["around"], (0, 2**62), SIZE, 8).views[0]
    assert view.ego is not None and view.ego.numpy()[degrees(camera) > EDGE].all() and view.ego.float().mean() < 0.3
    assert not view.sky.numpy()[0, 0], "nor is it sky"
    assert "lies beyond the lens's image and is left out" in capsys.readouterr().err
    assert with_ego_masks(log, ["around"], W).camera("around").ego_mask[0, 0]
