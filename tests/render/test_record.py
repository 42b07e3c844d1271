import json
import os
from dataclasses import replace

import numpy as np
import pytest
import torch
from street import car

from render.record import record
from render.video import read_image, read_video
from scenes.edit import Edit, edited
from scenes.insert import insert
from scenes.placement import Placement


def test_a_video_and_its_report_appear_together(street, tmp_path):
    scene = insert(street, car(), Placement("car/0001", 9, 2)).scene
    report = record(scene, "front_camera", tmp_path / "out.mp4", shift=2.0, facts={"enhanced": None}, warnings=["mind the gap"])
    assert sorted(os.listdir(tmp_path)) == ["out.json", "out.mp4"]
    assert len(list(read_video(tmp_path / "out.mp4"))) == 8
    told = json.loads((tmp_path / "out.json").read_text())
    assert told == json.loads(json.dumps(report))
    assert told["camera"] == "front_camera" and told["lateral_shift_m"] == 2.0 and told["fps"] == 10.0
    assert len(told["frames"]) == 8
    assert told["frames"][0]["world_from_cam"][1][3] == pytest.approx(2)
    assert told["warnings"] == ["mind the gap"]
    assert told["inserted"][0]["track"] == "inserted_car_0001"
    assert {"render", "write"} == set(told["ms_per_frame"])
    assert {"sidestep", "torch", "warp-lang"} <= set(told["versions"])
    assert told["seed"] == 0


def test_what_took_the_place_of_another_is_told_as_inserted(street, tmp_path):
    """It was never there either, and is another instance to harmonize."""
    scene = edited(street, Edit(replace={"veh_1": replace(car("van"), meta={"id": "van/0001"})}))
    record(scene, "front_camera", tmp_path / "out.mp4", times_us=street.frame_times("front_camera")[:1])
    (told,) = json.loads((tmp_path / "out.json").read_text())["inserted"]
    assert (told["track"], told["label"], told["instance"]) == ("veh_1", "van", 1)
    shifted = edited(street, Edit(shift={"veh_1": (0.0, 1.0)}))
    assert record(shifted, "front_camera", tmp_path / "b.mp4", times_us=street.frame_times("front_camera")[:1])["inserted"] == []


def test_frames_that_are_missing_leave_their_gap(street, tmp_path):
    times = street.frame_times("front_camera")[[0, 1, 4, 5]]
    record(street, "front_camera", tmp_path / "out.mp4", times_us=times)
    assert [t for t, _ in read_video(tmp_path / "out.mp4").timed()] == pytest.approx((times - times[0]).tolist(), abs=12)


def test_kept_outputs_come_as_files(street, tmp_path):
    times = street.frame_times("front_camera")[:2]
    record(street, "front_camera", tmp_path / "out.mp4", times_us=times, keep=("rgb", "depth", "flow_prev"))
    assert read_image(tmp_path / "out/rgb/000000.png").shape == (54, 96, 3)
    depth = np.load(tmp_path / "out/depth/000001.npy")
    assert depth.shape == (54, 96) and depth.dtype == np.float32
    assert os.listdir(tmp_path / "out/flow_prev") == ["000001.npy"]


def test_kept_outputs_replace_kept_outputs_and_nothing_else(street, tmp_path):
    times = street.frame_times("front_camera")[:1]
    record(street, "front_camera", tmp_path / "out.mp4", times_us=times, keep=("rgb", "depth"))
    record(street, "front_camera", tmp_path / "out.mp4", times_us=times, keep=("depth",))
    assert os.listdir(tmp_path / "out") == ["depth"]
    (tmp_path / "s1").mkdir()
    (tmp_path / "s1/scene.usda").touch()
    with pytest.raises(FileExistsError, match="s1 holds something else than kept frames"):
        record(street, "front_camera", tmp_path / "s1.mp4", times_us=times, keep=("depth",))
    assert os.listdir(tmp_path / "s1") == ["scene.usda"]
    assert not (tmp_path / "s1.mp4").exists()


def test_frames_are_finished_on_their_way(street, tmp_path):
    def invert(frames):
        for frame in frames:
            assert frame.alpha is not None
            yield replace(frame, rgb=1 - frame.rgb)

    times = street.frame_times("front_camera")[:2]
    record(street, "front_camera", tmp_path / "a.mp4", times_us=times)
    report = record(street, "front_camera", tmp_path / "b.mp4", times_us=times, stages={"invert": invert}, needs=("alpha",))
    a, b = (next(iter(read_video(tmp_path / name))) for name in ("a.mp4", "b.mp4"))
    assert (a + b - 1).abs().mean() < 0.03
    assert {"render", "invert", "write"} == set(report["ms_per_frame"])


def test_a_failure_on_the_way_leaves_nothing(street, tmp_path):
    def fail(frames):
        yield next(frames)
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        record(street, "front_camera", tmp_path / "out.mp4", keep=("depth",), stages={"fail": fail})
    assert os.listdir(tmp_path) == []


def test_the_same_clip_twice_is_the_same_clip(street, tmp_path):
    times = street.frame_times("front_camera")[:2]
    for name in ("a", "b"):
        record(street, "front_camera", tmp_path / f"{name}.mp4", times_us=times, keep=("rgb", "depth"))
    for file in ("rgb/000001.png", "depth/000001.npy"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_contact_sheets_hold_every_picture(tmp_path):
    from render.contact import BAND, GAP, write_contact_sheet

    red, blue = torch.zeros(20, 30, 3), torch.zeros(20, 30, 3)
    red[..., 0], blue[..., 2] = 1, 1
    write_contact_sheet(tmp_path / "c.png", ["recorded", "shifted"], [("0.0 s", [red, blue]), ("1.0 s", [None, red])])
    sheet = read_image(tmp_path / "c.png")
    assert sheet.shape == (BAND + 2 * (20 + BAND), GAP + 2 * (30 + GAP), 3)
    assert sheet[BAND + 10, GAP + 15].tolist() == [1, 0, 0]
    assert sheet[BAND + 10, GAP + 36 + 15].tolist() == [0, 0, 1]
    assert sheet[BAND + 20 + BAND + 10, GAP + 36 + 15].tolist() == [1, 0, 0]
