from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

from recon import FitConfig, open_log, reconstruct
from recon.log import Log, LogCamera, Packed
from recon.views.drawn_over import drawn_over
from recon.views.egomask import DOWN as FALLING
from recon.views.egomask import ego_mask, not_the_street, with_ego_masks
from recon.views.frames import load_frames
from recon.views.staying import _ways
from render import render_frame
from render.album import references_of
from render.compare import psnr
from render.rays import camera_rays
from scenes.camera import Camera
from scenes.lenses import Fisheye, Pinhole
from scenes.poses import CAM_FROM_FLU, inverse, small_poses
from scenes.trajectory import Trajectory

SIZE = W, H = 320, 180
EYE, FINE = 1.5, 3
ACROSS, DOWN = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
BONNET = DOWN > 150 + ((ACROSS - W / 2) / 40) ** 2
SHINY = np.random.default_rng(7)
GRAIN = np.random.default_rng(3).integers(60, 120, (512, 512))


def drive(count: int = 24, step: float = 1.0, turn: float = 0.0, lens=None) -> LogCamera:
    """A camera 1.5 m above a plane, going straight on, or turning left by so many radians a frame."""
    angles = turn * np.arange(count)
    at = np.cumsum(step * np.stack([np.cos(angles), np.sin(angles)], 1), 0)
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    poses[:, 0, 0] = poses[:, 1, 1] = torch.from_numpy(np.cos(angles))
    poses[:, 1, 0] = torch.from_numpy(np.sin(angles))
    poses[:, 0, 1] = -poses[:, 1, 0]
    poses[:, :2, 3], poses[:, 2, 3] = torch.from_numpy(at), EYE
    poses = poses @ inverse(CAM_FROM_FLU)
    lens = lens or Pinhole(200, 200, W / 2, 80)
    return LogCamera("front", lens, *SIZE, (Path("none"),) * count, 100_000 * torch.arange(count), poses)


def street(camera: LogCamera, i: int, bonnet: np.ndarray | None = BONNET, ahead: bool = False) -> np.ndarray:
    """Asphalt with two unbroken lines, far hills, and what rides along: a car ahead, and a bonnet that shines ever differently."""
    pose = camera.world_from_cam[i].numpy()
    rays = camera_rays(camera.camera(i, FINE * W, FINE * H)).double().numpy() @ pose[:3, :3].T
    falls = rays[..., 2] < -0.02
    far = np.where(falls, -pose[2, 3] / np.where(falls, rays[..., 2], -1), 0)
    x, y = (pose[k, 3] + far * rays[..., k] for k in (0, 1))
    picture = np.where(falls, GRAIN[(x * 8).astype(int) % 512, (y * 8).astype(int) % 512], 200.0)
    picture[falls & (np.abs(np.abs(y) - 1.8) < 0.1)] = 230
    across, down = np.meshgrid((np.arange(FINE * W) + 0.5) / FINE, (np.arange(FINE * H) + 0.5) / FINE)
    picture[~falls & (down > 80 - 15 * np.abs(np.sin(across / 30)))] = 90
    picture = picture.reshape(H, FINE, W, FINE).mean((1, 3))
    if ahead:
        picture[95:125, 140:180] = 40
    if bonnet is not None:
        picture[bonnet] = 25 + SHINY.integers(0, 20)
    return np.repeat(picture.clip(0, 255).astype(np.uint8)[..., None], 3, 2)


def found(camera: LogCamera, **what) -> np.ndarray | None:
    return ego_mask(camera, range(len(camera)), lambda i: street(camera, i, **what))


@pytest.mark.parametrize("lens", [None, Fisheye(190, 190, W / 2, 80, 0.02, 0.0, 0.0, 0.0)], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("turn", [0.0, 0.004], ids=["straight", "turning"])
def test_a_bonnet_is_found_and_little_else(lens, turn):
    mask = found(drive(turn=turn, lens=lens))
    assert mask is not None and mask.shape == (H, W)
    assert mask[BONNET].mean() > 0.99
    assert mask[~BONNET].mean() < 0.06


@pytest.mark.parametrize("turn", [(-0.3, 0, 0), (0, 1.5, 0), (0.2, 0.7, 0.3)], ids=["down", "aside", "askew"])
def test_what_stands_moves_away_from_where_the_camera_goes_whichever_way_it_looks(turn):
    mount = inverse(CAM_FROM_FLU) @ small_poses(torch.tensor([*turn, 0, 0, 0]))
    view, travel = Camera(Pinhole(30.0, 30.0, 24.0, 16.0), 48, 32, mount), torch.tensor([0.01, 0.0, 0.0], dtype=torch.float64)
    ways, rises, known = _ways(view, travel)
    points = 7 * camera_rays(view).double() @ mount[:3, :3].T
    later = view.lens.project((points - travel) @ mount[:3, :3])
    moved = torch.nn.functional.normalize(later - view.pixel_centres(), dim=-1)
    assert float((moved * torch.from_numpy(ways)).sum(-1).median()) > 0.999
    falls = torch.nn.functional.normalize(points, dim=-1)[..., 2]
    assert known.all() and torch.allclose(torch.from_numpy(rises), falls) and (falls < -FALLING).any()


def test_a_narrow_bonnet_begins_at_the_lower_edge():
    narrow = BONNET & (DOWN > 150 + ((ACROSS - W / 2) / 12) ** 2)
    mask = found(drive(), bonnet=narrow)
    assert mask is not None and mask[narrow].mean() > 0.9 and not mask[:, :24].any()


@pytest.mark.parametrize("what", [{}, {"ahead": True}], ids=["empty", "behind a car"])
@pytest.mark.parametrize("turn", [0.0, 0.004], ids=["straight", "turning"])
def test_a_street_without_one_shows_none(what, turn):
    assert found(drive(turn=turn), bonnet=None, **what) is None


def test_the_light_of_its_own_headlamps_is_no_bonnet():
    """Dark but for a pool of light on the road that goes along, brightest right before the car."""
    camera = drive()
    pool = np.exp(-(((ACROSS - W / 2) / 90) ** 2) - ((DOWN - H) / 40) ** 2)[..., None]
    night = lambda i: (street(camera, i, None) * (0.1 + 0.9 * pool)).astype(np.uint8)  # noqa: E731
    assert ego_mask(camera, range(len(camera)), night) is None


def test_a_car_that_stands_or_has_few_pictures_tells_nothing():
    assert found(drive(step=0.0)) is None
    assert found(drive(count=9)) is None


def stamped(picture: np.ndarray, i: int) -> np.ndarray:
    """With the time at its foot, which changes, and a logo at its top."""
    image = Image.fromarray(picture.copy())
    draw = ImageDraw.Draw(image)
    draw.text((8, H - 16), f"2026-11-28  14:{10 + i // 9:02d}:{7 * i % 60:02d}   {30 + 3 * i % 10} km/h", (255, 255, 255))
    draw.rectangle((W - 60, 6, W - 8, 22), (20, 60, 160))
    draw.text((W - 54, 8), "ROADCAM", (255, 200, 0))
    return np.asarray(image)


STAMPED = np.any([stamped(np.zeros((H, W, 3), np.uint8), i).any(-1) for i in range(24)], 0)


@pytest.mark.parametrize("turn", [0.0, 0.004], ids=["straight", "turning"])
def test_a_stamp_that_changes_and_a_logo_are_found_and_little_else(turn):
    camera = drive(turn=turn)
    drawn = drawn_over(camera, range(24), lambda i: stamped(street(camera, i, None), i))
    assert drawn is not None and drawn[STAMPED].mean() > 0.98
    assert not drawn[36:-36].any() and drawn.mean() < 0.1
    assert ego_mask(camera, range(24), lambda i: stamped(street(camera, i, None), i), drawn) is None


def test_a_bonnet_is_found_below_a_stamp():
    camera = drive()
    stamps = lambda i: stamped(street(camera, i), i)  # noqa: E731
    drawn = drawn_over(camera, range(24), stamps)
    mask = ego_mask(camera, range(24), stamps, drawn)
    assert drawn[:24][STAMPED[:24]].all() and mask[BONNET].mean() > 0.97 and mask[~BONNET].mean() < 0.06


def test_what_is_far_away_or_rides_along_is_not_drawn():
    """A tower from the horizon up to the picture's top, clouds, a car ahead, and a bonnet."""
    camera = drive()

    def towered(i):
        picture = street(camera, i, ahead=True).copy()
        picture[:70, 100:112:3] = 60
        picture[10:40:4, 200:260] = 215
        return picture

    assert drawn_over(camera, range(24), towered) is None


def test_the_views_of_a_fit_leave_out_what_is_drawn_over_videos_alone(monkeypatch, capsys):
    camera = drive()
    monkeypatch.setattr(LogCamera, "image", lambda self, i, *size: stamped(street(self, i, None), i))
    log = Log("walk", Path("walk"), {"front": camera}, (), (), Trajectory(camera.times_us, camera.world_from_cam), {}, ("front",))
    view = load_frames(log, ["front"], (0, 2**62), SIZE, 8).views[3]
    assert view.ego is not None and view.ego[torch.from_numpy(STAMPED)].float().mean() > 0.98 and view.ego.float().mean() < 0.1
    said = capsys.readouterr().err
    assert "of its pictures, " in said and "is drawn over them and is left out" in said and "recording car" not in said
    assert with_ego_masks(log, ["front"], W).camera("front").ego_mask[STAMPED].mean() > 0.98
    assert not [what for what in not_the_street(replace(log, sweeps=(None,)), camera, range(24), camera.image) if "drawn over" in what]


def creeping(count: int, step: float) -> LogCamera:
    """A camera that moves on by `step` metres in each of its first `count` frames, by one metre in the rest of 40."""
    camera = drive(count=40, lens=Pinhole(200, 200, W / 2, 120))
    poses = camera.world_from_cam.clone()
    poses[:count, 0, 3] = poses[count - 1, 0, 3] - step * torch.arange(count - 1, -1, -1)
    return replace(camera, world_from_cam=poses)


def test_a_street_before_a_car_that_stands_is_no_bonnet():
    """Its poses drift by millimetres, which is no motion."""
    still = street(creeping(40, 0.003), 0, None)
    assert ego_mask(creeping(40, 0.003), range(40), lambda i: still) is None


def test_pictures_are_looked_at_where_the_car_gets_on():
    camera, looked = creeping(24, 0.03), []
    ego_mask(camera, range(40), lambda i: looked.append(i) or street(camera, i, None))
    assert min(looked) == 23


def test_the_street_before_drive_002_sets_off_is_no_bonnet(pandaset):
    camera = open_log(pandaset).camera("front_camera")
    assert ego_mask(camera, range(20), lambda i: camera.image(i, 240, 135)) is None


def test_what_the_camera_says_counts():
    said = np.zeros((9, 16), bool)
    assert found(replace(drive(), ego_mask=said)) is None
    said[-1] = True
    assert found(replace(drive(), ego_mask=said), bonnet=None) is said


def test_a_log_is_told_once(monkeypatch):
    camera, reads = drive(), []

    def image(self, i, width=None, height=None):
        reads.append(i)
        return street(self, i)

    monkeypatch.setattr(LogCamera, "image", image)
    ego = Trajectory(camera.times_us, camera.world_from_cam)
    log = Log("drive", Path("drive"), {"front": camera, "rear": drive()}, (), (), ego, {}, ("front",))
    told = with_ego_masks(log, ["front"], W)
    assert told.camera("front").ego_mask[BONNET].all() and told.camera("rear").ego_mask is None
    count = len(reads)
    assert 12 <= count <= 24
    again = with_ego_masks(told, ["front"], W)
    assert len(reads) == count and np.array_equal(again.camera("front").ego_mask, told.camera("front").ego_mask)


SMALL = (96, 54)
RED = np.arange(54)[:, None] >= 42 + np.zeros((1, 96))


def _red(camera: LogCamera, i: int) -> bytes:
    picture, packed = camera.image(i, *SMALL).copy(), BytesIO()
    picture[RED] = 200, 0, 0
    Image.fromarray(picture).save(packed, "png")
    return packed.getvalue()


@pytest.fixture(scope="module")
def behind_red(drive):
    """The made-up drive, the lower parts of whose pictures are red, which its camera says."""
    log = open_log(drive)
    camera = log.camera("front_camera")
    files = tuple(Packed(f"picture {i}", partial(_red, camera, i)) for i in range(len(camera)))
    lens = camera.lens.scaled(SMALL[0] / camera.width, SMALL[1] / camera.height)
    red = replace(camera, files=files, width=SMALL[0], height=SMALL[1], lens=lens, ego_mask=RED)
    return replace(log, cameras={**log.cameras, "front_camera": red})


def test_the_views_of_a_fit_know_it_and_it_is_no_street(behind_red, capsys):
    frames = load_frames(behind_red, ["front_camera"], (0, 2**62), SMALL, 4)
    view = frames.views[1]
    assert torch.equal(view.ego, torch.from_numpy(RED)) and view.to("cpu").ego is not None
    row, column = np.array([50, 30, 0]), np.array([10, 10, 48])
    assert view.shows_street(row, column).tolist() == [False, True, not view.sky[0, 24 * view.sky.shape[1] // 48]]
    assert not (frames.sky_of(view) & RED).any()
    assert "22.2%, shows the recording car" in capsys.readouterr().err


def test_nothing_of_it_gets_into_the_scene_its_report_and_its_photos(behind_red, street, tmp_path):
    config = FitConfig(steps=120, budget=11_000, stages=((0.0, 2), (0.5, 1)), grow_every=6)
    scene = reconstruct(behind_red, tmp_path / "scene", ["front_camera"], size=SMALL, held_out=4, config=config)
    mask = torch.from_numpy(RED)
    for t in scene.frame_times("front_camera")[[2, 4]].tolist():
        with torch.no_grad():
            shown = render_frame(scene, scene.camera("front_camera", t)).rgb
            truth = render_frame(street, street.camera("front_camera", t).resized(*SMALL)).rgb
        assert psnr(shown, truth, mask) > 20  # red is at 6
    row = scene.meta["held_out"][0]
    assert row["psnr"] > 25 and row["ssim"] < 0.995
    photo = references_of(tmp_path / "scene", scene).shots[0].read(*SMALL)
    assert (photo[RED][:, 0].astype(int) - photo[RED][:, 1]).max() < 120
