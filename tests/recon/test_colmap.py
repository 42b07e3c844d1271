import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from made_colmap import HEIGHT, UNIT, pictures_along, relative, write_colmap
from PIL import Image

from recon import open_log, reconstruct
from recon.fit.config import FitConfig
from recon.ground import estimate_ground
from recon.readers.gauge import find_gauge, up_from_cameras
from recon.readers.order import names_apart
from recon.seeds.dense import agreeing, cloud_from_pictures
from recon.views.frames import load_frames
from recon.views.gains import picture_gains
from render import render_clip
from scenes import Scene, load
from scenes.insert import insert
from scenes.pictures import ORIENTATION
from scenes.placement import Placement

pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")

ALL = (0, 2**62)


def test_a_workspace_reads_as_its_pictures_were_taken(workspace, street):
    log = open_log(workspace, metres_per_unit=1 / UNIT)
    camera = log.camera("camera")
    truth = torch.stack([c.world_from_cam for c in pictures_along(street)])
    torch.testing.assert_close(relative(camera.world_from_cam), relative(truth), atol=1e-6, rtol=0)
    assert [f.name for f in camera.files] == [f"{i:03d}.png" for i in range(12)] and camera.image(3).shape == (54, 96, 3)
    assert log.sweeps == () and log.meta["metric"] is True and camera.times_us.diff().unique().tolist() == [500_000]
    assert log.meta["clock"].startswith("made up, 0.5 s from one picture to the next")


def test_z_is_up_and_the_body_looks_ahead_whatever_way_the_model_lies(workspace):
    log = open_log(workspace)
    body = log.ego.world_from_body[0]
    assert body[2, 2] > 0.999 and body[0, 0] > 0.999 and body[:3, 3].abs().max() < 1e-9


def test_the_cameras_height_makes_metres(workspace):
    log = open_log(workspace, camera_height=HEIGHT)
    walked = (log.ego.world_from_body[-1] - log.ego.world_from_body[0])[:3, 3].norm()
    assert log.meta["metric"] and float(walked) == pytest.approx(11 * 0.5, rel=0.06)


def test_without_metres_a_log_says_so_and_stands_at_a_streets_size(workspace):
    log = open_log(workspace)
    assert log.meta["metric"] is False
    assert 3 < float((log.ego.world_from_body[-1] - log.ego.world_from_body[0])[:3, 3].norm()) < 9


def test_metres_given_twice_or_to_a_log_that_has_them_are_refused(workspace, drive):
    with pytest.raises(ValueError, match="give one of them"):
        open_log(workspace, camera_height=1.5, metres_per_unit=2.0)
    with pytest.raises(ValueError, match="is in metres already; leave out --camera-height"):
        open_log(drive, camera_height=1.5)
    with pytest.raises(ValueError, match="--metres-per-unit must be positive"):
        open_log(workspace, metres_per_unit=0.0)


def test_points_stand_where_their_pictures_show_them(workspace):
    log = open_log(workspace, metres_per_unit=1 / UNIT)
    frames = load_frames(log, ["camera"], ALL, (96, 54), 0)
    seen = agreeing(log, frames, log.points, estimate_ground(log.points.xyz, log.ego))
    cloud, _ = cloud_from_pictures(log, frames, log.points, seen, [], np.ones((2, 3)))
    assert len(cloud.xyz) > 1000
    height = cloud.xyz[:, 2] + HEIGHT  # the road is flat and everything else above it
    assert np.quantile(height, 0.02) > -0.15 and (np.abs(height) < 0.15).mean() > 0.2


def test_the_middle_of_every_eight_photos_is_held_out(workspace):
    frames = load_frames(open_log(workspace), ["camera"], ALL, (48, 27), 8)
    assert [v.index for v in frames.held_out()] == [4]


def test_photos_of_different_exposure_are_brought_to_one(street, tmp_path):
    gains = [1.0, 0.6, 0.8, 1.0, 0.7, 0.9]
    dark = write_colmap(tmp_path / "dark", street, {"": pictures_along(street, count=6)}, gains)
    even = write_colmap(tmp_path / "even", street, {"": pictures_along(street, count=6)})
    sizes = (["camera"], ALL, (96, 54), 0)
    made, wanted = ([v.image.float().mean() for v in load_frames(open_log(p), *sizes).views] for p in (dark, even))
    ratio = torch.stack(made) / torch.stack(wanted)
    assert ratio.std() / ratio.mean() < 0.03 < torch.tensor(gains).std() / torch.tensor(gains).mean()


def test_gains_follow_the_points_that_pictures_share():
    generator = np.random.default_rng(0)
    own = generator.uniform(0.2, 0.6, (400, 3))
    truth = np.array([[1.0, 1.0, 1.0], [0.7, 0.8, 0.9], [1.3, 1.2, 1.1]])
    shown = [generator.choice(400, 200, replace=False) for _ in truth]
    found = picture_gains([own[p] * g for p, g in zip(shown, truth, strict=True)], shown, 400)
    np.testing.assert_allclose(found / found[0], truth, rtol=1e-3)
    assert (picture_gains([own[:5], own[:5] * 2], [np.arange(5)] * 2, 400) == 1).all()  # too few to tell


def test_up_needs_no_second_direction_of_view():
    """A car's camera that looks ahead and down still finds up: the car moves level."""
    tilt = 0.2
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 0] = [0, -1, 0]
    poses[:, :3, 1] = [-np.sin(tilt), 0, -np.cos(tilt)]
    poses[:, :3, 2] = [np.cos(tilt), 0, -np.sin(tilt)]
    poses[:, 0, 3] = np.arange(5)
    np.testing.assert_allclose(up_from_cameras(poses), [0, 0, 1], atol=0.01)
    one = up_from_cameras(poses[:1])  # a single picture has but its own up
    np.testing.assert_allclose(one, -poses[0, :3, 1], atol=1e-6)


def test_a_height_without_ground_is_refused_with_the_other_fix():
    poses = np.tile(np.eye(4), (3, 1, 1))
    with pytest.raises(ValueError, match="--metres-per-unit"):
        find_gauge(poses, np.zeros((0, 3)), camera_height=1.5)


@pytest.mark.parametrize(("registered", "lead"), [(5, "front"), (2, "left")])
def test_the_front_camera_is_the_body_unless_it_lacks_most_pictures(street, tmp_path, registered, lead):
    pair = {"left": pictures_along(street, "left_camera", count=6), "front": pictures_along(street, count=6)[:registered]}
    log = open_log(write_colmap(tmp_path / "pair", street, pair), metres_per_unit=1 / UNIT)
    assert next(iter(log.cameras)) == lead and log.meta["body"].startswith(f"camera {lead},")


def test_no_camera_takes_anothers_name():
    """A name has no blanks and dashes: folders that differ by no more than these do not give one."""
    assert names_apart({1: ["front-left/1.jpg", "front-left/2.jpg"], 2: ["rear/1.jpg"]}) == {1: "front_left", 2: "rear"}
    assert names_apart({1: ["front-left/1.jpg", "front-left/2.jpg"], 2: ["front_left/1.jpg"]}) is None


def test_names_with_spaces_in_a_text_model_are_read_whole(own, workspace):
    """COLMAP itself ends them at the first."""
    images = own / "sparse/0/images.txt"
    images.write_text("# some\n\n" + re.sub(r"(\d{3}\.png)", r"1 May, Straße \1", images.read_text()), newline="\r\n")
    for file in (own / "images").iterdir():
        file.rename(file.with_name(f"1 May, Straße {file.name}"))
    found = open_log(own).camera("camera")
    assert [f.name for f in found.files] == [f"1 May, Straße {i:03d}.png" for i in range(12)]
    torch.testing.assert_close(found.world_from_cam, open_log(workspace).camera("camera").world_from_cam)


def test_pictures_of_another_size_than_the_models_are_named_with_the_fix(own):
    file = own / "images/003.png"
    with Image.open(file) as picture:
        picture.resize((48, 27)).save(file)
    with pytest.raises(ValueError, match="003.png is 48x27, but the model in .* has a camera of 96x54; put the pictures that the model"):
        open_log(own)


def test_pictures_that_are_not_stored_upright_are_refused_with_the_fix(own):
    """COLMAP takes them as they are stored: up would be to the side, and the ground a wall."""
    file = own / "images/003.png"
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    with Image.open(file) as picture:
        picture.save(file, exif=exif)
    with pytest.raises(ValueError, match="made of photos as they are stored, and 003.png is not stored upright; turn them and make"):
        open_log(own)


def test_pictures_of_a_model_are_opened_once_and_the_first_for_its_mask(own, monkeypatch):
    really, asked = Image.open, []
    monkeypatch.setattr(Image, "open", lambda file, *rest: asked.append(file.name) or really(file, *rest))
    open_log(own)
    assert sorted(asked) == sorted([f"{i:03d}.png" for i in range(12)] + ["000.png"])


def test_a_model_of_one_picture_is_refused_for_that(street, tmp_path):
    one = write_colmap(tmp_path / "one", street, {"": pictures_along(street, count=1)})
    with pytest.raises(ValueError, match="sparse/0 registers one picture, 000.png, and one has no depth; make a model of more pictures"):
        open_log(one)


def test_masks_are_said_not_to_be_heeded(own, capsys):
    open_log(own)
    assert "masks" not in capsys.readouterr().err
    (own / "masks").mkdir()
    file = own / "images/000.png"
    with Image.open(file) as picture:
        picture.putalpha(255)
        picture.save(file)
        open_log(own)
        said = capsys.readouterr().err
        assert "walk/masks masks a part of the pictures, which is not heeded" in said and "000.png" not in said
        picture.putalpha(Image.linear_gradient("L").resize(picture.size))
        picture.save(file)
    open_log(own)
    assert "images/000.png masks a part of the pictures, which is not heeded" in capsys.readouterr().err


def test_a_missing_picture_is_named_with_the_nearest_that_is_not_registered(own):
    (own / "images/007.png").rename(own / "images/007 (1).png")
    with pytest.raises(FileNotFoundError, match=r"images/007.png is missing; .* registers it. Did you mean 007 \(1\).png\?"):
        open_log(own)
    (own / "images/007 (1).png").rename(own / "images/017.png")
    with pytest.raises(FileNotFoundError, match=r"images/007.png is missing; .* registers it\.$"):  # nothing but others of its series
        open_log(own)


def test_a_model_that_lacks_a_file_or_is_cut_short_is_named(own):
    points = own / "sparse/0/points3D.txt"
    whole = points.read_text()
    points.unlink()
    with pytest.raises(FileNotFoundError, match="points3D.txt is missing"):
        open_log(own)
    points.write_text(whole)
    images = own / "sparse/0/images.txt"
    images.write_text(images.read_text()[:200])
    with pytest.raises(ValueError, match="sparse/0"):
        open_log(own)


@pytest.mark.parametrize(
    "line",
    ["SIMPLE_RADIAL 96 54 58 48 27 -0.1", "OPENCV 96 54 58 57 48 27 -0.1 0.02 0.001 -0.002", "RADIAL_FISHEYE 96 54 58 48 27 0.05 -0.01",
     "FULL_OPENCV 96 54 58 57 48 27 -0.1 0.02 0.001 -0.002 0.01 0.02 0.01 0.003", "OPENCV_FISHEYE 96 54 58 57 48 27 0.1 -0.02 0.01 0.001",
     "SIMPLE_FISHEYE 96 54 58 48 27", "FISHEYE 96 54 58 57 48 27"],
)  # fmt: skip
def test_distorted_lenses_project_as_colmaps_do(own, line):
    import pycolmap

    (own / "sparse/0/cameras.txt").write_text(f"1 {line}\n")
    lens = open_log(own).camera("camera").lens
    kind, width, height, *params = line.split()
    theirs = pycolmap.Camera(model=kind, width=int(width), height=int(height), params=[float(p) for p in params])
    points = np.random.default_rng(0).uniform([-0.6, -0.4, 1.0], [0.6, 0.4, 1.0], (50, 3)) * 3
    np.testing.assert_allclose(lens.project(torch.from_numpy(points)).numpy(), theirs.img_from_cam(points), atol=1e-9)


def test_a_lens_that_is_not_read_is_named_with_the_fix(own):
    cameras = own / "sparse/0/cameras.txt"
    cameras.write_text("1 FOV 96 54 57.6 57.6 48 27 0.1\n")
    with pytest.raises(ValueError, match="FOV.*colmap image_undistorter"):
        open_log(own)


def test_poses_without_points_are_a_drive(own, workspace):
    """As those have who know their poses and write them for COLMAP: pictures are asked for points then."""
    (own / "sparse/0/points3D.txt").write_text("")
    lines = (own / "sparse/0/images.txt").read_text().splitlines()
    (own / "sparse/0/images.txt").write_text("".join(f"{line}\n\n" for line in lines[::2]))
    log = open_log(own, metres_per_unit=1 / UNIT)
    assert log.points is None and log.meta["metric"] is True and not log.sweeps
    known = open_log(workspace, metres_per_unit=1 / UNIT).camera("camera").world_from_cam
    torch.testing.assert_close(log.camera("camera").world_from_cam, known)


def test_points_that_no_picture_is_said_to_show_are_none(own, workspace):
    images = own / "sparse/0/images.txt"
    lines = images.read_text().splitlines()
    images.write_text("\n".join(line if ".png" in line or line.startswith("#") else "" for line in lines) + "\n")
    points = own / "sparse/0/points3D.txt"
    points.write_text("\n".join(" ".join(line.split()[:8]) for line in points.read_text().splitlines() if line[:1].isdigit()) + "\n")
    log = open_log(own)
    assert log.points is None and len(log.camera("camera")) == len(open_log(workspace).camera("camera"))


def test_a_model_is_read_whatever_lies_beside_it(own, workspace):
    import pycolmap

    model = own / "sparse/0"
    pycolmap.Reconstruction(str(model)).write_binary(str(model))
    for name in ("images.txt", "points3D.txt"):
        (model / name).unlink()
    (model / "cameras.txt").write_text("# of another model\n")
    assert len(open_log(own).camera("camera")) == len(open_log(workspace).camera("camera"))
    (model / "points3D.bin").unlink()
    with pytest.raises(FileNotFoundError, match="points3D.bin is missing"):
        open_log(own)


def test_without_pycolmap_the_fix_is_named(workspace, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ValueError, match=r"pip install 'sidestep\[colmap\]'"):
        open_log(workspace)


@pytest.fixture(scope="module")
def scene(workspace, tmp_path_factory):
    out = tmp_path_factory.mktemp("fit") / "walk"
    config = FitConfig(steps=150, budget=6000, stages=((0.0, 2), (0.5, 1)), grow_every=6)
    reconstruct(open_log(workspace), out, config=config)
    return out


def test_pictures_alone_become_a_scene(scene):
    made = load(scene)
    assert isinstance(made, Scene) and (made.rig["camera"].width, made.rig["camera"].height) == (96, 54)
    row = made.meta["held_out"][0]
    assert row["frames"] == [4] and row["psnr"] > 22 and row["psnr"] > row["mean_psnr"] + 2


def test_a_scene_without_metres_refuses_what_is_in_metres(scene, street):
    made = load(scene)
    assert made.meta["metric"] is False
    with pytest.raises(ValueError, match="lateral shift is in metres.*--camera-height 1.5m"):
        render_clip(made, "camera", shift=2.0)
    with pytest.raises(ValueError, match="--metres-per-unit"):
        insert(made, street.actors[0].asset, Placement("car/0001", 5, 0))
    assert len(list(render_clip(made, "camera", width=32, height=18))) == 12
    metric = replace(made, meta={**made.meta, "metric": True})
    assert next(render_clip(metric, "camera", shift=2.0, width=32, height=18)).rgb is not None


def test_lund_reads_with_all_its_pictures(shared):
    log = open_log(shared / "lund", camera_height=1.6)
    assert len(log.camera("camera")) == 24 and len(log.points.xyz) == 1453
    # a walk of a hundred metres down a street: level, and straight ahead
    walked = log.ego.world_from_body[:, :3, 3].diff(dim=0)
    assert 60 < float(walked.norm(dim=1).sum()) < 180 and float(walked[:, 2].abs().sum()) < 0.05 * float(walked.norm(dim=1).sum())
    bodies = log.ego.world_from_body
    assert (bodies[:, 2, 2] > 0.97).all() and (bodies[:, 0, 0] > 0.8).all()


def test_a_model_is_found_where_tools_leave_it_and_the_nearest_is_taken(own, workspace):
    (own / "colmap").mkdir()
    (own / "sparse").rename(own / "colmap/sparse")  # ns-process-data
    found = open_log(own).camera("camera")
    assert len(found) == len(open_log(workspace).camera("camera")) and found.files[0].parent == own / "images"
    shutil.copytree(own / "colmap/sparse", own / "sparse")  # 3D Gaussian splatting's convert.py leaves one of distorted pictures deeper
    shutil.move(own / "colmap", own / "distorted")
    cameras = own / "distorted/sparse/0/cameras.txt"
    cameras.write_text(cameras.read_text().replace(" 96 54 ", " 192 108 "))
    (own / "distorted/sparse/0/images.txt").open("a").write("# the fuller one\n" * 100)
    assert len(open_log(own).camera("camera")) == len(found)
