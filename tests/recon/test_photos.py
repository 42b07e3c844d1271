import math
import shutil

import pytest
import torch
from made_colmap import pictures_along, write_colmap
from PIL import Image

from recon import open_log
from recon.readers import photos as reader
from recon.readers.sfm import read_model
from render.video import VideoWriter

pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")


@pytest.fixture(scope="module")
def walk(street, tmp_path_factory):
    return write_colmap(tmp_path_factory.mktemp("photos") / "walk", street, {"": pictures_along(street, count=6)})


@pytest.fixture
def solved(walk, monkeypatch):
    """Structure from motion that knows its answer; the calls it got."""
    calls = []

    def solve(pictures, names, workspace, ordered, angle_of_view):
        calls.append((names, ordered, angle_of_view))
        shutil.copytree(walk / "sparse", workspace / "sparse")
        images = workspace / "sparse/0/images.txt"
        text = images.read_text()
        for i, name in enumerate(names):
            text = text.replace(f"{i:03d}.png", name)
        images.write_text(text)
        return len(names)

    monkeypatch.setattr(reader, "solve", solve)
    return calls


def test_photos_are_placed_once_and_read_from_then_on(walk, solved, tmp_path):
    shutil.copytree(walk / "images", tmp_path / "walk")
    first, second = open_log(tmp_path / "walk"), open_log(tmp_path / "walk", camera_height=1.5)
    assert len(solved) == 1 and solved[0][1] is False and (tmp_path / "walk.sfm/sparse/0").is_dir()
    assert [f.parent.name for f in first.camera("camera").files] == ["walk"] * 6
    assert first.meta["metric"] is False and second.meta["metric"] is True


def test_a_known_angle_of_view_is_kept_and_another_one_begins_anew(walk, solved, tmp_path):
    shutil.copytree(walk / "images", tmp_path / "walk")
    camera = open_log(tmp_path / "walk").camera("camera")
    angle = 2 * math.atan(camera.width / 2 / camera.lens.focal()[0])
    assert solved[0][2] is None
    open_log(tmp_path / "walk", angle_of_view=1.005 * angle)
    assert len(solved) == 1
    with pytest.raises(ValueError, match="walk.sfm was made with an angle of view of .*delete it to begin again with 20deg"):
        open_log(tmp_path / "walk", angle_of_view=math.radians(20))
    shutil.rmtree(tmp_path / "walk.sfm")
    open_log(tmp_path / "walk", angle_of_view=angle)
    assert solved[1][2] == angle
    with pytest.raises(ValueError, match="from 5deg to 150deg, got 200deg"):
        open_log(tmp_path / "walk", angle_of_view=math.radians(200))


def test_who_knows_his_lenses_needs_no_angle_of_view(walk, drive):
    for path in (walk, drive):
        with pytest.raises(ValueError, match="leave out --angle-of-view"):
            open_log(path, angle_of_view=1.0)


def test_photos_of_another_size_are_left_out_and_said(walk, solved, tmp_path, capsys):
    shutil.copytree(walk / "images", tmp_path / "walk")
    Image.new("RGB", (54, 96)).save(tmp_path / "walk/turned.png")
    open_log(tmp_path / "walk")
    assert len(solved[0][0]) == 6 and "left out turned.png: not 96x54" in capsys.readouterr().err


def test_a_video_keeps_its_clock(solved, tmp_path):
    with VideoWriter(tmp_path / "drive.mp4", 25, 96, 54) as video:
        for i in range(12):
            video.write(torch.full((54, 96, 3), i / 12))
    camera = open_log(tmp_path / "drive.mp4").camera("camera")
    assert solved[0] == ([f"{i:06d}.jpg" for i in range(0, 12, 2)], True, None)  # 25 frames a second, every second one
    assert camera.times_us.diff().unique().tolist() == [80_000] and camera.image(1).shape == (54, 96, 3)


def test_what_cannot_be_placed_leaves_nothing_behind(walk, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise ValueError("only 2 of 6 pictures could be placed")

    monkeypatch.setattr(reader, "solve", fail)
    shutil.copytree(walk / "images", tmp_path / "walk")
    with pytest.raises(ValueError, match="only 2 of 6"):
        open_log(tmp_path / "walk")
    assert [p.name for p in tmp_path.iterdir()] == ["walk"]


def test_a_folder_that_cannot_be_written_is_named_with_the_fix(walk, tmp_path, monkeypatch):
    from pathlib import Path

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    shutil.copytree(walk / "images", tmp_path / "walk")
    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(PermissionError, match="walk.sfm .Permission denied.; copy walk to a folder that you can write"):
        open_log(tmp_path / "walk")


def test_pictures_without_overlap_are_refused_with_the_fix(tmp_path):
    folder = tmp_path / "noise"
    folder.mkdir()
    for i in range(3):
        grey = torch.randint(0, 256, (48, 64, 3), generator=torch.Generator().manual_seed(i), dtype=torch.uint8)
        Image.fromarray(grey.numpy()).resize((256, 192)).save(folder / f"{i}.png")
    with pytest.raises(ValueError, match="of 3 pictures in .* could be placed; take them closer together"):
        open_log(folder)


@pytest.mark.parametrize("told", [False, True])
def test_real_photos_are_placed(shared, tmp_path, told):
    """Six photos of a street, 4 metres apart, which know the focal length, or whose angle of view is told."""
    folder = tmp_path / "street"
    folder.mkdir()
    for i in range(8, 14):
        with Image.open(shared / f"lund/images/{i:02d}.jpg") as photo:
            knows = {} if told else {"exif": photo.info["exif"]}
            photo.resize((640, 480)).save(folder / f"{i:02d}.jpg", quality=95, **knows)
    (known,) = read_model(shared / "lund/colmap_sparse").cameras.values()
    angle = 2 * math.atan(known.width / 2 / known.params[0])
    log = open_log(folder, angle_of_view=angle if told else None)
    camera = log.camera("camera")
    if told:
        assert camera.lens.focal()[0] == pytest.approx(known.params[0] * 640 / known.width)
    # how many of so few are placed is luck: matching draws lots
    assert len(camera) >= 3 and len(log.points.xyz) > 50 and camera.lens.kind == "opencv"
    assert torch.isfinite(log.ego.world_from_body).all() and camera.image(0).shape == (480, 640, 3)
