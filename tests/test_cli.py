"""The front door as a user meets it: separate processes where exit codes and output count, small scenes everywhere."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import street as made
import torch
from front_door import SHOOT, environment, sidestep

from render.video import read_video
from scenes import Databank, SplatModel, load, save
from scenes.convert import stood_up
from scenes.usd.splats import save_gaussians


def test_the_main_job_makes_a_video_and_a_report(desk, tmp_path):
    sidestep(
        desk, "render", "street", "--camera", "front_camera", "--lateral-shift", "2m", "--size", "64x36", "--duration", "300ms",
        "--insert", "car/0001@9m,2.5m", "--insert", "van/0001@7m,-300cm,yaw=5deg,speed=8m/s", "--databank", "bank",
        "-o", str(tmp_path / "out.mp4"), "--outputs", "instance",
    )  # fmt: skip
    assert len(list(read_video(tmp_path / "out.mp4"))) == 3
    told = json.loads((tmp_path / "out.json").read_text())
    assert told["lateral_shift_m"] == 2
    assert [i["label"] for i in told["inserted"]] == ["car", "van"]
    seen = np.load(tmp_path / "out" / "instance" / "000000.npy")
    assert {2, 3} <= set(np.unique(seen))


def test_the_recording_car_changes_lane_or_drives_a_path_of_its_own(door, tmp_path):
    words = [*SHOOT[:-1], str(tmp_path / "out.mp4"), "--size", "32x18", "-w"]

    def middle(*told):
        """Metres to the left at the clip's fourth frame, and what the report calls the path."""
        _, errors = door([*words, *told])
        report = json.loads((tmp_path / "out.json").read_text())
        recorded = made.street().camera("front_camera", report["frames"][3]["time_us"]).world_from_cam
        return report["frames"][3]["world_from_cam"][1][3] - float(recorded[1, 3]), report["path"], errors

    left, path, errors = middle("--lateral-shift", "-1m@0s,1m@600ms")
    assert abs(left) < 0.4 and path == "--lateral-shift -1m@0s,1m@0.6s" and "slides sideways; give it more time" in errors
    (tmp_path / "t.csv").write_text("time_s,x_m,y_m\n0,0,0.5\n0.8,4,0.5\n")
    left, path, errors = middle("--trajectory", str(tmp_path / "t.csv"))
    assert left == pytest.approx(0.5, abs=1e-6) and path == f"--trajectory {tmp_path / 't.csv'}" and not errors.count("warning")
    assert middle()[:2] == (0, "as recorded")


def test_a_camera_of_ones_own_is_read_from_a_file(door, tmp_path):
    file = tmp_path / "roof.json"
    file.write_text('{"moved_m": [0, 0, 0.5], "yaw_deg": -10, "angle_of_view_deg": 120, "lens": "fisheye", "size": [64, 40]}')
    words = ["render", "street", "--camera", str(file), "-o", str(tmp_path / "out.mp4"), "--duration", "300ms", "-w"]
    door([*words, "--lateral-shift", "1m", "--enhance"])
    told, recorded = json.loads((tmp_path / "out.json").read_text()), made.street()
    assert told["camera"] == str(file) and told["camera_file"] == json.loads(file.read_text()) and told["size"] == [64, 40]
    assert told["lens"]["type"] == "Fisheye" and told["lens"]["params"][0] == pytest.approx(32 / np.deg2rad(60))
    mount = np.array(told["body_from_cam"])
    assert mount[:3, 3].tolist() == [1, 0, 2] and mount[:3, 2] == pytest.approx([np.cos(np.deg2rad(10)), -np.sin(np.deg2rad(10)), 0])
    for frame in told["frames"]:
        body = recorded.ego.shifted(lateral=1.0).at(frame["time_us"]).numpy()
        assert np.array(frame["world_from_cam"]) == pytest.approx(body @ mount)
    file.write_text('{"yaw_deg": 180}')
    _, errors = door([*words, "-o", str(tmp_path / "roof.mp4")], 2)
    assert "roof.json is the camera's file, and" in errors and file.read_text() == '{"yaw_deg": 180}'
    _, errors = door([*words, "--size", "32x18"])
    told = json.loads((tmp_path / "out.json").read_text())
    assert told["size"] == [32, 18] and f"warning: {file} shows what no camera recorded on " in errors and len(told["warnings"]) == 1


def test_an_asset_that_nobody_sees_is_said(door, tmp_path):
    words = [*SHOOT[:-1], str(tmp_path / "out.mp4"), "--size", "32x18", "--duration", "100ms", "--databank", "bank"]
    _, errors = door([*words, "--insert", "car/0001@-7m,0m"])
    assert "car/0001 is never in view: X is metres forward" in errors
    assert "never in view" in json.loads((tmp_path / "out.json").read_text())["warnings"][0]


def test_an_inserted_asset_stays_in_the_scene_until_its_layer_goes(desk, tmp_path):
    shutil.copytree(desk / "street", tmp_path / "street")
    before = (tmp_path / "street" / "background.usdc").read_bytes()
    place = ["--at", "20m,-3.5m", "--yaw", "-5deg", "--speed", "8m/s"]
    run = sidestep(tmp_path, "insert", "street", "--asset", "car/0001", *place, "--databank", str(desk / "bank"))
    assert "edits/inserted_car_0001.usda" in run.stdout
    scene = load(tmp_path / "street")
    (actor,) = [a for a in scene.actors if a.asset.meta.get("inserted")]
    assert actor.trajectory.at(made.START_US)[:2, 3].tolist() == pytest.approx([20, -3.5])
    assert (tmp_path / "street" / "background.usdc").read_bytes() == before
    (tmp_path / "street" / "edits" / "inserted_car_0001.usda").unlink()
    assert len(load(tmp_path / "street").actors) == 1


def test_actors_are_edited_and_the_edit_is_listed_and_undone(door, tmp_path):
    shutil.copytree("street", tmp_path / "street")
    street = str(tmp_path / "street")
    changes = ["--shift", "veh_1=-1m,0.5m", "--retime", "veh_1=+0.1s", "--replace", "veh_1=van/0001"]
    out, _ = door(["edit", street, *changes, "--databank", "bank"])
    assert "edits/edit.usda" in out and "--undo edit" in out
    (actor,) = load(street).actors
    assert actor.asset.label == "van" and int(actor.trajectory.times_us[0]) == made.START_US + 100_000
    assert "edit  kind edit  shift_m {'veh_1': [-1.0, 0.5]}" in door(["info", street])[0]
    door(["edit", f"{street}/scene.usda", "--remove", "veh_1", "--name", "gone"])  # what usdview opens names the scene as well
    assert load(street).actors == ()
    assert "again as it was" in door(["edit", street, "--undo", "gone", "--undo", "edit"])[0]
    assert load(street).actors[0].asset.label == "car"


def test_another_asset_of_another_splat_model_and_light_is_said(door, tmp_path):
    shutil.copytree("street", tmp_path / "street")
    bank = Databank(tmp_path / "bank")
    bank.add(replace(made.car(), model=SplatModel(antialias=True), meta={"ground_linear": [0.001, 0.1, 0.1]}))
    bank.add(replace(made.car(), model=SplatModel("ewa")))
    _, errors = door(["edit", str(tmp_path / "street"), "--replace", "veh_1=car/0001", "--databank", str(bank.path)])
    assert "warning: car/0001 was trained with antialias True, but the scene is drawn with antialias False, so" in errors
    assert "warning: car/0001 should be " in errors and "the limit is 4 times" in errors
    _, errors = door(["edit", str(tmp_path / "street"), "--replace", "veh_1=car/0002", "--databank", str(bank.path)])
    assert "was trained with" not in errors, "how splats are projected is said by no PLY, and hardly shows"


def test_undoing_an_insertion_says_which_edits_go_with_it(door, tmp_path):
    shutil.copytree("street", tmp_path / "street")
    street, bank = str(tmp_path / "street"), ["--databank", "bank"]
    put_in = ["insert", street, "--asset", "car/0001", "--at", "20m,-3.5m", *bank]
    door(put_in)
    door(["edit", street, "--replace", "inserted_car_0001=van/0001", *bank])
    out, _ = door(["edit", street, "--undo", "inserted_car_0001", "--undo", "edit"])
    assert "without inserted_car_0001, and without edit, which changed only what inserted_car_0001 had brought" in out
    door(put_in)
    door(["edit", street, "--remove", "inserted_car_0001"])
    assert "inserted_car_0001_2" in door(put_in)[0]
    assert [a.track for a in load(street).actors] == ["veh_1", "inserted_car_0001_2"]
    _, errors = door(["edit", street, "--shift", "inserted_car_0001=1m,0m"], 1)
    assert "the edit edit removed it; --undo edit brings it back" in errors


def test_undoing_and_changing_at_once_is_all_or_nothing(door, tmp_path):
    shutil.copytree("street", tmp_path / "street")
    street = str(tmp_path / "street")
    door(["edit", street, "--shift", "veh_1=0m,1m", "--name", "aside"])
    _, errors = door(["edit", street, "--undo", "aside", "--remove", "veh_2"], 1)
    assert 'actor "veh_2" is not in' in errors and [e["name"] for e in load(street).meta["edits"]] == ["aside"]
    door(["edit", street, "--undo", "aside", "--shift", "veh_1=0m,2m", "--name", "aside"])
    door(["edit", street, "--retime", "veh_1=+0.1s", "--name", "late"])
    out, _ = door(["edit", street, "--undo", "aside"])
    told = "but late still goes on from where aside had put veh_1, and as what: undo that too, and give it anew"
    assert f"as it was without aside; {told}" in out


def test_an_asset_can_follow_a_csv(door, tmp_path):
    shutil.copytree("street", tmp_path / "street")
    (tmp_path / "t.csv").write_text("time_s,x_m,y_m\n0,10,0\n0.5,15,0\n")
    path = ["--trajectory", str(tmp_path / "t.csv")]
    door(["insert", str(tmp_path / "street"), "--asset", "car/0001", *path, "--databank", "bank"])
    actor = load(tmp_path / "street").actors[-1]
    assert actor.trajectory.at(made.START_US + 250_000)[:2, 3].tolist() == pytest.approx([12.5, 0])
    (line,) = [line for line in door(["info", str(tmp_path / "street")])[0].splitlines() if line.startswith("edits")]
    assert "trajectory t.csv" in line and "yaw_rad" not in line


def test_the_databank_is_listed_and_shown(door):
    listed, _ = door(["assets", "list", "--databank", "bank"])
    assert "car/0001" in listed and "van/0001" in listed and "2 assets" in listed
    shown, _ = door(["assets", "show", "van/0001", "--databank", "bank"])
    for part in ("4.20 m long", "van", "860", "3", "CC0-1.0", "made for tests"):
        assert part in shown


def test_an_own_asset_is_added_and_the_databank_checked(door, tmp_path):
    body = made.box((1.8, 1.5, 4.2), (0.2, 0.2, 0.8))  # y up, z forward, but standing on z = 0
    save(body, tmp_path / "own.ply")
    add = ["assets", "add", str(tmp_path / "own.ply"), "--label", "car", "--databank", str(tmp_path / "bank")]
    assert "--forward or --up, or --force" in door([*add, "--up", "y", "--forward", "x"], 1)[1]
    out, _ = door([*add, "--up", "y", "--forward", "z", "--licence", "CC0-1.0"])
    assert "as car/0001: 4.2" in out
    check = ["assets", "check", "--databank", str(tmp_path / "bank")]
    assert "1 assets" in door(check)[0]
    door([*add, "--up", "y", "--forward", "x", "--force"])
    assert "car/0002 is 1.8" in door(check, 1)[0]


@pytest.mark.parametrize("path", ["street", "bank", "street/background.usdc", "bank/assets/car/0001/asset.usdc"])
def test_info_and_validate_take_all_kinds_of_path(door, path):
    assert "splats" in door(["info", path])[0]
    assert json.loads(door(["info", path, "--json"])[0])["splats"] > 0
    assert "is valid" in door(["validate", path])[0]


def test_splats_are_converted_and_told_how_faithfully(door, tmp_path):
    out, _ = door(["convert", "bank/assets/car/0001/asset.usdc", str(tmp_path / "a.spz")])
    assert "a.spz: " in out and "bytes each; off by at most" in out
    errors = door(["convert", str(tmp_path / "a.spz"), str(tmp_path / "a.spz")], 1)[1]
    assert "a.spz exists; give -w to replace it, or another name\n" in errors
    door(["convert", str(tmp_path / "a.spz"), str(tmp_path / "b.compressed.ply")])
    assert json.loads(door(["info", str(tmp_path / "b.compressed.ply"), "--json"])[0])["format"] == "compressed PLY"
    assert "is valid" in door(["validate", str(tmp_path / "b.compressed.ply")])[0]
    assert "background.usdc" in door(["convert", "street", str(tmp_path / "c.ply")], 1)[1]
    assert 'suffix ".obj"' in door(["convert", str(tmp_path / "a.spz"), str(tmp_path / "c.obj")], 1)[1]


def test_a_stage_that_is_y_up_is_converted_to_z_up_and_that_is_said(door, tmp_path):
    source, target = tmp_path / "y.usda", tmp_path / "z.ply"
    save_gaussians(source, made.car().gaussians)
    assert "turned" not in door(["convert", str(source), str(target)])[0]
    plain = load(target).means
    source.write_text(source.read_text().replace('upAxis = "Z"', 'upAxis = "Y"').replace("metersPerUnit = 1", "metersPerUnit = 0.01"))
    out, _ = door(["convert", str(source), str(target), "-w"])
    assert "y.usda is turned from y up to z up and scaled from units of 0.01 m to metres" in out and "off by at most nothing" in out
    x, y, z = (0.01 * plain).unbind(1)
    torch.testing.assert_close(load(target).means, torch.stack([x, -z, y], 1), rtol=1e-5, atol=1e-6)


def test_splats_whose_up_is_said_stand_upright_in_files_that_have_one(door, tmp_path):
    car, lying = made.car().gaussians, tmp_path / "lying.ply"
    save(stood_up(car, lying, "-y"), lying)  # what was its z is its x now
    for name, said in (("a.glb", "x up to y up"), ("a.spz", "x up to y up"), ("a.usdc", "x up to z up"), ("a.ply", "x up to z up")):
        assert f"turned from {said}" in door(["convert", str(lying), str(tmp_path / name), "--up", "x"])[0]
        heights = load(tmp_path / name).means[:, 2]
        torch.testing.assert_close(heights.sort().values, car.means[:, 2].sort().values, rtol=0, atol=1e-3)
        plain = door(["convert", str(lying), str(tmp_path / name), "-w"])[0]
        assert ("does not say which of its axes points up" in plain) == (name != "a.ply")
    assert "turned from y up to z up" in door(["convert", str(tmp_path / "a.spz"), str(tmp_path / "b.ply")])[0]
    for command, name in (("convert", "c.ply"), ("render", "-o=c.mp4")):
        words = [command, "bank/assets/car/0001/asset.usdc", *name.replace("c.", f"{tmp_path}/c.").split("="), "--up", "y"]
        assert "an asset, whose z is up" in door(words, 2)[1]
    lying.write_bytes(lying.read_bytes().replace(b"element", b"comment Vertical axis: y\nelement", 1))
    assert "its vertical axis is y" in door(["convert", str(lying), str(tmp_path / "c.spz")])[1]


def test_splats_alone_are_rendered_from_around(door, tmp_path):
    door(["convert", "bank/assets/car/0001/asset.usdc", str(tmp_path / "a.splat")])
    words = ["--size", "64x36", "--duration", "100ms", "-o", str(tmp_path / "a.mp4"), "--outputs", "alpha"]
    door(["render", str(tmp_path / "a.splat"), *words])  # its only camera: orbit
    alpha = np.load(tmp_path / "a" / "alpha" / "000000.npy")
    assert alpha[18, 32] > 0.5 and alpha[0, 0] < 0.1
    assert "it has orbit" in door(["render", str(tmp_path / "a.splat"), "--camera", "front", *words, "-w"], 1)[1]


def test_a_converted_asset_stays_one_as_usd(door, tmp_path):
    door(["convert", "bank/assets/car/0001/asset.usdc", str(tmp_path / "a.usda")])
    assert json.loads(door(["info", str(tmp_path / "a.usda"), "--json"])[0])["label"] == "car"
    for name in ("b.usdc", "b.spz"):  # of its folder, too, it is known that z is up
        assert "--up" not in "".join(door(["convert", "bank/assets/car/0001", str(tmp_path / name)]))


@pytest.mark.parametrize(
    "words",
    ["recon", "assets extract", "assets add", "assets list", "assets show", "assets check", "insert", "edit", "render", "pairs", "train",
     "enhance", "convert", "info", "validate", "doctor", "demo"],
)  # fmt: skip
def test_help_speaks_of_values_as_they_are_written(door, words):
    """Not as Python has them: {None}|STR is nothing that can be typed."""
    told = door([*words.split(), "--help"], 0)[0]
    assert "--" in told and "None" not in told and "STR]" not in told


def test_the_version_is_told(door):
    assert re.fullmatch(r"sidestep (\d+\.\d+\.\d+|unknown: .*)\n", door(["--version"])[0])


def test_streams_that_the_caller_closed_or_that_lie_on_a_full_disk_stop_nothing(desk, tmp_path):
    words = [
        sys.executable,
        "-m",
        "sidestep",
        "render",
        desk / "street",
        "--size",
        "32x18",
        "--duration",
        "100ms",
        "-o",
        tmp_path / "a.mp4",
    ]
    line = shlex.join(map(str, words))
    run = subprocess.run(f"{line} 2>&-", shell=True, env=environment(), stdout=subprocess.PIPE, text=True)
    assert run.returncode == 0 and sorted(os.listdir(tmp_path)) == ["a.json", "a.mp4"], run.stdout
    run = subprocess.run(f"{line} >&- 2>&-", shell=True, env=environment(), stdout=subprocess.PIPE, text=True)
    assert run.returncode == 1 and not run.stdout  # a.mp4 exists, which nobody hears
    if os.path.exists("/dev/full"):
        run = subprocess.run(f"{line} -w 2>/dev/full", shell=True, env=environment(), stdout=subprocess.PIPE, text=True)
        assert (run.returncode, run.stdout) == (0, f"wrote {tmp_path / 'a.mp4'}, {tmp_path / 'a.json'}\n")


def test_existing_outputs_are_replaced_with_w(door, tmp_path):
    words = [*SHOOT[:-1], str(tmp_path / "out.mp4"), "--size", "32x18", "--duration", "100ms"]
    (tmp_path / "out.json").write_text("precious")
    assert "out.json exists" in door(words, 1)[1]
    assert not (tmp_path / "out.mp4").exists()
    door([*words, "-w"])
    assert json.loads((tmp_path / "out.json").read_text())["size"] == [32, 18]


def test_what_a_new_clip_does_not_replace_or_widens_is_said(door, tmp_path):
    words = [*SHOOT[:-1], str(tmp_path / "out.mp4"), "--duration", "100ms", "-w"]
    assert "warning" not in door([*words, "--size", "32x18", "--outputs", "rgb"])[1]
    _, errors = door([*words, "--size", "33x17"])
    assert "out.mp4 has 34x18 pixels for 33x17: H.264 needs even sides" in errors
    assert f"{tmp_path / 'out'} holds frames of an earlier clip, not of this out.mp4; --outputs" in errors
    assert len(json.loads((tmp_path / "out.json").read_text())["warnings"]) == 2
    assert "warning" not in door([*words, "--size", "32x18", "--outputs", "rgb"])[1]
