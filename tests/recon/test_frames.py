import json
import math
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from recon import open_log, reconstruct
from recon.fit.config import FitConfig
from recon.log import LidarPoints, Log, LogCamera, Packed, SparsePoints, Sweep
from recon.views.frames import Frames, load_frames, size_like
from recon.views.skies import fine_sky, like_sky
from recon.views.sky_told import _cells, under_their_sky
from recon.views.view import View
from scenes.lenses import Pinhole
from scenes.poses import CAM_FROM_FLU, inverse, small_poses
from scenes.trajectory import Trajectory

ALL = (0, 2**62)
SIZE = (240, 120)


def _log(
    sky: tuple[int, int, int], strikes: bool, wall: tuple[int, int, int] = (231, 229, 226), glare: bool = False, up_to: float = 4.9
) -> Log:
    """Three pictures of a street: sky to the left, half of it clipped where there is glare, to the right a wall as white as an overcast
    one, and lidar on it, or on the road."""
    generator = np.random.default_rng(0)
    image = generator.integers(20, 120, (120, 240, 3)).astype(np.uint8)
    image[:50] = sky
    image[:70, 130:] = wall
    if glare:
        image[:50, 60:120] = 255
    buffer = BytesIO()
    Image.fromarray(image).save(buffer, "png")
    times = torch.arange(3) * 100_000
    bodies = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses = bodies @ inverse(CAM_FROM_FLU)
    camera = LogCamera("front", Pinhole(120, 120, 120, 60), *SIZE, (Packed("street", buffer.getvalue),) * 3, times, poses)
    # ten metres ahead: to the right and up to 5 m, or below
    y, z = np.meshgrid(np.linspace(-10.5, -1.0, 80), np.linspace(*((0.0, up_to) if strikes else (-4.0, -1.0)), 60))
    xyz = np.stack([np.full(y.size, 10.0), y.ravel(), z.ravel()], 1)
    sweep = Sweep(0, 100_000, lambda: LidarPoints(xyz, np.full(len(xyz), 100_000), np.zeros(len(xyz), np.int64)))
    return Log("street", Path("street"), {"front": camera}, (sweep,), (), Trajectory(times, bodies), {}, ("front",))


def _skies(log: Log) -> tuple[np.ndarray, np.ndarray]:
    frames = load_frames(log, ["front"], ALL, SIZE, 0)
    return frames.views[0].sky.numpy(), frames.sky_of(frames.views[0])


def test_beyond_a_wire_what_looks_like_the_sky_is_sky_and_a_window_that_mirrors_it_is_none():
    image = np.full((240, 480, 3), 60, np.uint8)
    image[:84] = image[160:200, 100:140] = (150, 180, 225)
    image[80] = 40  # a wire, and under it a strip that the coarse mask is not sure of
    coarse = np.zeros((120, 240), bool)
    coarse[:39] = True
    view = View(0, 0, 0, torch.from_numpy(image), False, torch.from_numpy(coarse))
    frames = Frames(["front"], [(480, 240)], [view])
    sure, rim = frames.sky_of(view), frames.sky_with_rim(view)
    assert sure[:78].all() and not sure[80:].any()
    assert (rim | ~sure).all() and rim[82].all() and not rim[80].any() and not rim[85:].any()
    bonnet = torch.zeros(240, 480, dtype=torch.bool)
    bonnet[82:, :99] = True
    assert not frames.sky_with_rim(replace(view, ego=bonnet))[82, :99].any()


def test_a_sky_is_looked_for_where_it_may_be_and_no_farther_down():
    """The same pixels as of a picture that goes on below."""
    image = np.random.default_rng(1).integers(0, 40, (90, 160, 3)).astype(np.uint8)
    image[:20] += 150
    coarse = np.zeros((45, 80), bool)
    coarse[:9, 10:70] = True
    taller = np.concatenate([image, image[40:]])
    found, more = fine_sky(image, coarse), fine_sky(taller, np.concatenate([coarse, np.zeros((25, 80), bool)]))
    assert found.any() and (found == more[:90]).all() and not more[90:].any()
    assert (like_sky(image, found) == like_sky(taller, more)[:90]).all()
    assert not fine_sky(image, np.zeros_like(coarse)).any()


@pytest.mark.parametrize("sky", [(240, 238, 236), (226, 150, 96), (92, 84, 100), (9, 8, 11), (150, 180, 225)])
def test_a_sky_of_any_colour_is_told_by_lidar_from_a_white_wall(sky):
    for mask in _skies(_log(sky, strikes=True)):
        assert mask[3:40, 5:115].mean() > 0.95 and mask[:, 140:].mean() < 0.02 and mask[60:].mean() < 0.02


def _cells_of(log: Log, time_us: int):
    view = View(0, 0, time_us, torch.zeros(120, 240, 3, dtype=torch.uint8), False, torch.zeros(120, 240, dtype=torch.bool))
    return _cells(log, ["front"], [view], None)[0]


def test_the_horizon_is_where_the_camera_has_it():
    """Of one that looks 20 degrees up, and of one that looks aside, lying on its side."""
    log = _log((9, 8, 11), strikes=True)
    camera = log.camera("front")
    up, side = (small_poses(torch.tensor(turn)) for turn in ([math.radians(20), 0, 0, 0, 0, 0], [0, 0, math.pi / 2, 0, 0, 0]))
    above = [
        _cells_of(replace(log, cameras={"front": replace(camera, world_from_cam=camera.world_from_cam @ t)}), 0).above for t in (up, side)
    ]
    assert above[0][:100].all() and not above[0][105:].any()
    assert above[1].any() and not above[1].all() and (above[1] == above[1][:1]).all()


def test_what_stands_there_is_told_by_the_nearest_sweeps():
    log = _log((9, 8, 11), strikes=True)

    def sweep(time_us: int, y: float) -> Sweep:
        sweep = log.sweeps[0]
        return replace(sweep, time_us=time_us, read=lambda: replace(sweep.read(), xyz=sweep.read().xyz + [0.0, y, 0.0]))

    moved = replace(log, sweeps=tuple(sweep(t, 10.0 if t < 250_000 else 0.0) for t in range(200_000, 600_000, 100_000)))
    struck = _cells_of(moved, 400_000).struck
    assert struck[:, 140:].any() and not struck[:, :100].any()


def test_without_lidar_or_points_only_blue_is_sky():
    for mask in _skies(_log((150, 180, 225), strikes=False)):
        assert mask[3:40, 5:115].mean() > 0.95 and mask[:, 140:].mean() < 0.02
    for mask in _skies(_log((226, 150, 96), strikes=False)):
        assert not mask.any()


def test_without_lidar_the_points_that_pictures_showed_tell_a_sky():
    log = replace(_log((226, 150, 96), strikes=False), sweeps=())
    frames = load_frames(log, ["front"], ALL, SIZE, 0)
    y, z = np.meshgrid(np.linspace(-9.5, 9.5, 40), np.linspace(-4, 0.7, 20))  # on what is below the sky, and up the wall's left part
    wall = np.stack(np.meshgrid(np.linspace(-9, -1.5, 20), np.linspace(1, 4.5, 12)), -1).reshape(-1, 2)
    xyz = np.concatenate([np.stack([y.ravel(), z.ravel()], 1), wall])
    points = SparsePoints(np.insert(xyz, 0, 10.0, axis=1), {"front": (np.arange(len(xyz)), *[np.zeros(0, np.int64)] * 2)})
    told = under_their_sky(log, ["front"], frames.views, points)
    for view in told:  # those that show none of the points learn from their neighbours
        for mask in (view.sky.numpy(), frames.sky_of(view)):
            assert mask[3:40, 5:115].mean() > 0.95 and mask[:, 140:].mean() < 0.02 and mask[60:].mean() < 0.02
    few = replace(points, seen={"front": (np.arange(5),) * 3})
    assert not any(v.sky.any() for v in under_their_sky(log, ["front"], frames.views, few)), "five points teach nothing"


def test_what_is_clipped_beside_blue_is_sky_where_lidar_does_not_strike_it():
    """A low sun behind houses blinds the camera: what shines there is no wall, and what shines and is struck is one."""
    dazzled = _log((150, 180, 225), strikes=True, wall=(255, 255, 255), glare=True)
    for mask in _skies(dazzled):
        assert mask[3:40, 5:115].mean() > 0.95 and mask[:, 140:].mean() < 0.02 and mask[60:].mean() < 0.02
    for mask in _skies(replace(dazzled, sweeps=())):
        assert mask[3:40, 5:55].mean() > 0.95 and mask[:, 70:].mean() < 0.02  # nothing tells


def test_of_a_wall_that_beams_reach_only_the_foot_of_all_is_no_sky():
    for mask in _skies(_log((226, 150, 96), strikes=True, up_to=0.35)):  # two degrees, as KITTI's lidar
        assert mask[3:40, 5:115].mean() > 0.95 and mask[:, 140:].mean() < 0.02


def test_pictures_without_colour_tell_their_sky_by_lidar():
    grey = _log((235, 240, 250), strikes=True)
    plain = BytesIO()
    Image.open(BytesIO(grey.cameras["front"].files[0].read())).convert("L").save(plain, "png")
    camera = grey.cameras["front"]
    object.__setattr__(camera, "files", (Packed("grey", plain.getvalue),) * 3)
    for mask in _skies(grey):
        assert mask[3:40, 5:115].mean() > 0.95 and mask[:, 140:].mean() < 0.02
    for mask in _skies(replace(grey, sweeps=())):
        assert not mask.any()


def test_a_camera_of_sixteen_bits_of_grey_is_seen_as_one_of_eight():
    log, buffer = _log((150, 180, 225), strikes=False), BytesIO()
    eight = np.arange(SIZE[0] * SIZE[1]).reshape(SIZE[::-1]) % 256
    Image.fromarray((eight * 257).astype(np.uint16)).save(buffer, "png")
    camera = replace(log.camera("front"), files=(Packed("grey", buffer.getvalue),) * 3)
    assert np.array_equal(camera.image(0), np.repeat(eight[..., None], 3, 2))


@pytest.mark.parametrize(
    ("every", "frames", "unseen"),
    [(4, 8, [4]), (2, 8, [2, 4, 6]), (8, 8, [4]), (4, 5, [2]), (4, 4, [2]), (4, 3, []), (4, 1, []), (0, 8, [])],
)
def test_a_clip_begins_and_ends_with_frames_that_are_fitted(drive, every, frames, unseen):
    log = open_log(drive)
    times = log.camera("front_camera").times_us
    views = load_frames(log, ["front_camera"], (int(times[0]), int(times[frames - 1])), (96, 54), every).views
    assert len(views) == frames and [v.index for v in views if v.held_out] == unseen


def test_a_span_without_a_frame_is_refused_saying_so(drive):
    log = open_log(drive)
    with pytest.raises(ValueError, match="front_camera has no frame in the chosen span: none of its 8 lies there; choose a longer one"):
        load_frames(log, ["front_camera"], (-9, -1), (96, 54), 8)


def test_cameras_of_other_proportions_keep_them():
    def one(width: int, height: int) -> LogCamera:
        return LogCamera("front", Pinhole(120, 120, 60, 60), width, height, (), torch.zeros(0), torch.zeros(0, 4, 4))

    ahead, wide = one(1550, 2048), one(2048, 1550)  # as in Argoverse 2
    assert size_like(ahead, ahead, (626, 828)) == (626, 828) and size_like(wide, ahead, (626, 828)) == (827, 627)
    assert size_like(one(960, 540), one(1920, 1080), (640, 360)) == (640, 360)
    assert size_like(one(1920, 886), one(1920, 1280), (882, 588)) == (1060, 489)  # as Waymo's to the sides
    assert size_like(one(400, 100), one(1920, 1080), (1920, 1080)) == (400, 100), "no more than was recorded"
    assert size_like(one(200, 100), one(100, 100), (50, 100)) == (71, 71), "what is squeezed in one is squeezed in all"


def test_a_drive_whose_cameras_have_other_proportions_keeps_them(own_drive, tmp_path):
    folder = own_drive / "camera/left_camera"
    for file in folder.glob("*.jpg"):
        with Image.open(file) as picture:
            picture.crop((30, 0, 66, 54)).save(file, quality=95)  # upright
    lens = json.loads((folder / "intrinsics.json").read_text())
    (folder / "intrinsics.json").write_text(json.dumps(lens | {"cx": lens["cx"] - 30}))
    log = open_log(own_drive)
    frames = load_frames(log, ["front_camera", "left_camera"], ALL, (96, 54), 4)
    assert frames.sizes == [(96, 54), (36, 54)]
    scene = reconstruct(
        log, tmp_path / "s", ["front_camera", "left_camera"], size=(64, 36), held_out=4, config=FitConfig(steps=40, budget=6000)
    )
    camera = scene.rig["left_camera"]
    assert camera.height > camera.width and camera.lens.focal()[0] == pytest.approx(camera.lens.focal()[1], rel=0.02)
    row = next(r for r in scene.meta["held_out"] if r["camera"] == "left_camera")
    assert row["psnr"] > row["mean_psnr"] - 3
    with pytest.raises(ValueError, match="--size 200x54 is more than front_camera recorded, 96x54"):
        reconstruct(log, tmp_path / "large", size=(200, 54))
