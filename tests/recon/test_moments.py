"""When the pictures of a COLMAP model were taken, as files beside it and names tell it."""

import json
import shutil

import pytest
import torch
from made_colmap import UNIT, pictures_along, write_colmap

from recon import open_log
from scenes.poses import inverse

pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")


def renamed(folder, names):
    """A workspace whose pictures, in the order in which they were taken, have other names."""
    images = folder / "sparse/0/images.txt"
    lines = images.read_text()
    old = sorted(p.relative_to(folder / "images") for p in (folder / "images").rglob("*.png"))
    for before, name in zip(old, names, strict=True):
        lines = lines.replace(f" {before}\n", f" ={name}\n")
        (folder / "new" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "images" / before).rename(folder / "new" / name)
    images.write_text(lines.replace(" =", " "))
    shutil.rmtree(folder / "images")
    (folder / "new").rename(folder / "images")
    return folder


def test_two_cameras_share_the_moments_of_equal_names(street, tmp_path):
    pair = {"front": pictures_along(street, count=4), "left": pictures_along(street, "left_camera", count=4)}
    log = open_log(write_colmap(tmp_path / "pair", street, pair), metres_per_unit=1 / UNIT)
    assert list(log.cameras) == ["front", "left"] == list(log.front)
    assert log.cameras["front"].times_us.tolist() == log.cameras["left"].times_us.tolist()
    rig = log.rig(dict.fromkeys(log.cameras, (96, 54)))
    apart = inverse(rig["front"].body_from_cam) @ rig["left"].body_from_cam
    truth = inverse(street.rig["front_camera"].body_from_cam) @ street.rig["left_camera"].body_from_cam
    torch.testing.assert_close(apart, truth, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    "names",
    [[f"frame{i}.png" for i in range(12)], [f"{'ab'[i // 6]}/{i % 6:03d}.png" for i in range(12)],
     [f"{1533151603 + i / 4}.png" for i in range(12)],
     [str(1533151603547590 + 99_999 * i) + ".png" for i in range(12)], [str(315966253572412942 + 10**9 * i) + ".png" for i in range(12)]],
    ids=["unpadded", "two folders", "seconds", "microseconds", "nanoseconds"],
)  # fmt: skip
def test_pictures_follow_each_other_as_the_numbers_in_their_names_do(own, workspace, names):
    ours, truth = open_log(renamed(own, names)).camera("camera"), open_log(workspace).camera("camera")
    assert [str(f.relative_to(own / "images")) for f in ours.files] == names
    torch.testing.assert_close(ours.world_from_cam, truth.world_from_cam, atol=1e-9, rtol=0)


@pytest.mark.parametrize("layout", ["{camera}/{part}/{i:03d}.png", "{part}/{camera}/{i:03d}.png"])
def test_two_cameras_in_two_parts_of_a_drive_share_moments_part_by_part(street, tmp_path, layout):
    pair = {"front": pictures_along(street, count=4), "left": pictures_along(street, "left_camera", count=4)}
    names = [layout.format(camera=c, part="ab"[i // 2], i=i % 2) for c in pair for i in range(4)]
    log = open_log(renamed(write_colmap(tmp_path / "pair", street, pair), names))
    assert {name: len(camera) for name, camera in log.cameras.items()} == {"front": 4, "left": 4}
    for camera in log.cameras.values():
        assert camera.times_us.tolist() == [0, 500_000, 1_000_000, 1_500_000]
        assert [f.parts[-3:] for f in camera.files] == sorted(f.parts[-3:] for f in camera.files)


@pytest.mark.parametrize(
    "layout", ["{camera}_{i:03d}.png", "{i:03d}_{camera}.png", "cam{number}_{i}.png", "{i:03d}/{camera}.png", "run2/{camera}{i}.png"]
)
def test_pictures_of_one_moment_are_known_by_what_differs_in_a_cameras_names(street, tmp_path, layout):
    pair = {"front": pictures_along(street, count=4), "left": pictures_along(street, "left_camera", count=4)}
    names = [layout.format(camera=c, number=k + 1, i=i) for k, c in enumerate(pair) for i in range(4)]
    log = open_log(renamed(write_colmap(tmp_path / "pair", street, pair), names), metres_per_unit=1 / UNIT)
    assert [c.times_us.tolist() for c in log.cameras.values()] == [[0, 500_000, 1_000_000, 1_500_000]] * 2
    assert list(log.cameras) == (["cam1", "cam2"] if "{number}" in layout else ["front", "left"])
    front, left = log.cameras
    rig = log.rig(dict.fromkeys(log.cameras, (96, 54)))
    apart = inverse(rig[front].body_from_cam) @ rig[left].body_from_cam
    truth = inverse(street.rig["front_camera"].body_from_cam) @ street.rig["left_camera"].body_from_cam
    torch.testing.assert_close(apart, truth, atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", ["{us}.png", "{us}000.png", "f_{ms}_x.png", "{s:.6f}.png"])
def test_names_that_are_times_are_a_clock(street, tmp_path, name, capsys):
    pair = {"front": pictures_along(street, count=4), "left": pictures_along(street, "left_camera", count=4)}
    begun = 1533151603547000
    times = [begun + 100_000 * i + 20_000 * k for k in range(2) for i in range(4)]
    names = [f"{c}/" + name.format(us=t, ms=t // 1000, s=t / 1e6) for t, c in zip(times, 4 * ["front"] + 4 * ["left"], strict=True)]
    log = open_log(renamed(write_colmap(tmp_path / "pair", street, pair), names))
    assert log.cameras["front"].times_us.tolist() == [0, 100_000, 200_000, 300_000]
    assert log.cameras["left"].times_us.tolist() == [20_000, 120_000, 220_000, 320_000] and not capsys.readouterr().err
    assert log.meta["clock"] == "times in the pictures' names"


def test_names_that_are_numbers_tell_how_far_between_a_picture_was_taken(street, tmp_path, capsys):
    pair = {"front": pictures_along(street, count=4), "left": pictures_along(street, "left_camera", count=4)}
    names = [f"{c}/{100_000 * i + 20_000 * k}.png" for k, c in enumerate(pair) for i in range(4)]
    log = open_log(renamed(write_colmap(tmp_path / "pair", street, pair), names))
    assert log.cameras["front"].times_us.tolist() == [0, 500_000, 1_000_000, 1_500_000]
    assert log.cameras["left"].times_us.tolist() == [100_000, 600_000, 1_100_000, 1_600_000]
    assert not capsys.readouterr().err


def test_pictures_that_another_camera_took_before_or_after_the_first_are_named(street, tmp_path, capsys):
    pair = {"front": pictures_along(street, count=5), "left": pictures_along(street, "left_camera", count=5)}
    names = [f"{c}_{i + 2 * k:03d}.png" for k, c in enumerate(pair) for i in range(5)]
    log = open_log(renamed(write_colmap(tmp_path / "pair", street, pair), names))
    assert [len(c) for c in log.cameras.values()] == [5, 3] and len(log.points.seen["left"]) == 3
    assert "2 of 5 pictures of left are left out, the first of them" in capsys.readouterr().err


def test_a_camera_that_took_nothing_in_the_others_time_is_left_out_with_the_fix(street, tmp_path, capsys):
    pair = {"front": pictures_along(street, count=4), "left": pictures_along(street, "left_camera", count=4)}
    names = [f"{c}/{i + 1000 * k}.png" for k, c in enumerate(pair) for i in range(4)]
    log = open_log(renamed(write_colmap(tmp_path / "pair", street, pair), names))
    assert list(log.cameras) == ["front"]
    assert "camera left is left out, for it took no picture while front did; name pictures of one moment alike" in capsys.readouterr().err


def test_a_clock_beside_the_model_is_read(own):
    names = sorted(p.name for p in (own / "images").iterdir())
    (own / "sparse/0/times.json").write_text(json.dumps({n: 40_000 * i for i, n in enumerate(names)}))
    log = open_log(own)
    assert log.camera("camera").times_us.diff().unique().tolist() == [40_000] and log.meta["clock"] == "times.json"
    (own / "sparse/0/times.json").write_text(json.dumps({names[0]: 0}))
    with pytest.raises(ValueError, match="times.json must give whole microseconds"):
        open_log(own)


@pytest.mark.parametrize("unit", [1, 0.04])
def test_a_clock_of_another_unit_is_refused(own, unit):
    names = sorted(p.name for p in (own / "images").iterdir())
    (own / "sparse/0/times.json").write_text(json.dumps({n: unit * i for i, n in enumerate(names)}))
    with pytest.raises(ValueError, match="times.json must give whole microseconds by picture name; it has 0"):
        open_log(own)


def test_a_camera_with_two_pictures_at_a_moment_is_named_with_the_fix(own):
    names = sorted(p.name for p in (own / "images").iterdir())
    (own / "sparse/0/times.json").write_text(json.dumps({n: 40_000 * max(1, i) for i, n in enumerate(names)}))
    with pytest.raises(ValueError, match="one camera take 000.png and 001.png at one moment; give them different times in .*times.json"):
        open_log(own)
