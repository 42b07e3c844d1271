"""What the front door says to wrong usage, bad data and machines that lack something."""

import json
import shutil
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import pytest
import street as made
import torch
from front_door import SHOOT

from scenes import Gaussians, Placed, save
from scenes.alone import sole
from scenes.usd.splats import save_gaussians

INSERT = ["insert", "street", "--asset", "car/0001"]

USAGE = [
    (["rendr"], 'command "rendr" is not in sidestep; it has recon, assets,', "Did you mean render?"),
    ([*SHOOT, "--lateral-shift", "2"], "--lateral-shift", '"2" has no unit; write 2m (metres) or 200cm'),
    ([*SHOOT, "--lateral-shift", "2deg"], "--lateral-shift", "an angle, not a length"),
    ([*SHOOT, "--lateral-shift", "0m,2m@5s"], "--lateral-shift", "write it as 0m@2s,3.5m@5s"),
    ([*SHOOT, "--lateral-shift", "2m", "--trajectory", "t.csv"], "--trajectory is the whole path", "leave out --lateral-shift"),
    ([*SHOOT, "--start", "3"], "--start", '"3" has no unit; write 3s (seconds) or 3000ms'),
    ([*SHOOT, "--size", "640"], "--size", "as 640x360"),
    ([*SHOOT, "--outputs", "dept"], "--outputs", "Did you mean depth?"),
    ([*SHOOT, "--insert", "car/0001"], "--insert", "write ID@X,Y"),
    ([*SHOOT, "--size", "100000x9"], "--size", "at most 16384 pixels a side"),
    (["recon", "drive", "-o", "x", "--effort", "0"], "--effort", "write a number from 0.1 to 100, where 1 is the default, as 2"),
    (["recon", "drive", "-o", "x", "--effort", "nan"], "--effort", "write a number from 0.1 to 100"),
    ([*SHOOT, "--fps", "0"], "--fps", "write frames a second, above 0 and below 1000, as 10"),
    (["render", "street/background.usdc", *SHOOT[4:], "--insert", "car/1@5m,0m"], "--insert needs a scene", "usdc holds splats only"),
    (["render", "street/background.usdc", *SHOOT[4:], "--trajectory", "t.csv"], "--trajectory needs a scene", "usdc holds splats only"),
    (["render", "street/background.usdc", "--camera", "a.json", *SHOOT[4:]], "--camera a.json needs a scene", "usdc holds splats only"),
    ([*SHOOT, "--enhanc"], "--enhanc", "--enhance"),
    (["render", "street"], "--output", "required"),
    (INSERT, "--at 20m,-3.5m", "--trajectory t.csv"),
    ([*INSERT, "--at", "20m"], "--at", "as 20m,-3.5m"),
    ([*INSERT, "--at", "20m,0m", "--trajectory", "t.csv"], "--at 20m,-3.5m", "one of the two"),
    (
        [*INSERT, "--trajectory", "t.csv", "--speed", "5m/s"],
        "--trajectory also gives heading and speed",
        "leave out --yaw",
    ),
    (
        [*INSERT, "--trajectory", "t.csv", "--path", "lane"],
        "--trajectory also gives heading and speed",
        "leave out --yaw",
    ),
    (["assets", "lst"], "lst", "list"),
    (["edit", "street"], "nothing to do: give --remove", "--remove veh_12"),
    (["edit", "street", "--shift", "veh_1"], "--shift", "as veh_3=0m,1.5m"),
    (["edit", "street", "--retime", "veh_1=2"], "--retime", "write 2s (seconds) or 2000ms"),
    ([*SHOOT, "--weights", "mine.safetensors"], "--weights mine.safetensors have no effect without --enhance", "add it"),
    ([*SHOOT, "--outputs", "colour"], 'output "colour" does not exist', "normal, flow_prev"),
]


@pytest.mark.parametrize(("words", "what", "fix"), USAGE, ids=[" ".join(case[0][-2:]) for case in USAGE])
def test_wrong_usage_says_what_and_the_fix_and_exits_2(door, words, what, fix):
    _, errors = door(words, 2)
    message = " ".join(errors.replace("│", " ").split())
    assert what in message and fix in message


CAMERAS = "it has front_camera, left_camera. Did you mean front_camera?"

DATA = [
    (["render", "street", "--camera", "frnt", "-o", "x.mp4"], f'camera "frnt" is not in street; {CAMERAS}'),
    (["render", "street", "--camera", "roof.json", "-o", "x.mp4"], "roof.json does not exist"),
    (["render", "street", "--camera", "street/metadata.json", "-o", "x.mp4"], 'street/metadata.json has the unknown key "'),
    (["render", "stret", *SHOOT[2:]], "stret does not exist. Did you mean street?"),
    (["render", "bank", *SHOOT[2:]], "bank is a databank"),
    (["render", "street/background.usdc", *SHOOT[2:]], "is not in street/background.usdc; it has orbit"),
    ([*SHOOT[:-1], "clip.mp4"], "clip.mp4 exists; give -w to replace it"),
    (["render", "stret", "-o", "x.gif"], "x.gif must end in .mp4"),
    ([*SHOOT[:-1], ".", "-w"], ". must end in .mp4"),
    ([*SHOOT[:-1], "no/x.mp4"], "the folder no does not exist; create it first"),
    ([*SHOOT[:-1], "clip.mp4/x.mp4"], "cannot write clip.mp4/x.mp4: clip.mp4 is a file, not a folder"),
    ([*SHOOT, "--start", "20s"], "front_camera has 8 frames over 0.7s"),
    ([*SHOOT, "--insert", "van/2@5m,0m", "--databank", "bank"], "it has car/0001, van/0001. Did you mean van/0001?"),
    ([*SHOOT, "--insert", "car/0001@5m,0m"], "databank is not a databank"),
    (["assets", "extract", "street", "--databank", "clip.mp4"], "clip.mp4 is a file; a databank is a folder"),
    (["assets", "extract", "street", "--databank", "clip.mp4/bank"], "clip.mp4 is a file; a databank is a folder"),
    (["assets", "list"], "sidestep assets extract SCENE --databank databank, or assets add, makes one"),
    (["edit", "street", "--shift", "veh_1=0m,0m"], "by zero, which changes nothing"),
    ([*SHOOT, "--insert", "car/0001@trajectory=t.csv", "--databank", "bank"], "t.csv"),
    ([*INSERT, "--at", "5m,0m", "--start", "60s", "--databank", "bank"], "the drive lasts"),
    (["edit", "street", "--remove", "veh_2"], 'actor "veh_2" is not in street; it has veh_1. Did you mean veh_1?'),
    (["edit", "street", "--undo", "edit"], 'edit "edit" is not in street'),
    (["edit", "stret", "--remove", "veh_1"], "stret does not exist. Did you mean street?"),
    (["assets", "show", "cra/0001", "--databank", "bank"], "Did you mean car/0001?"),
    (["enhance", "street/metadata.json", "-o", "x.mp4"], "street/metadata.json cannot be decoded as video"),
    (["enhance", "gone.mp4", "-o", "x.mp4"], "gone.mp4"),
    (["enhance", "clip.mp4", "-o", "clip.mp4"], "clip.mp4 exists"),
    (["enhance", "clip.mp4", "-o", "x.mp4", "--weights", "gone.safetensors"], "gone.safetensors"),
    (["recon", "nowhere", "-o", "x"], "nowhere"),
    (["recon", "bank", "-o", "x"], "not a known layout"),
    (["recon", "bank", "-o", "street"], "street exists; give -w"),
    (["recon", "bank", "-o", "bank", "-w"], "bank is not a scene, so it is left alone"),
    (["info", "clip.mp4"], "clip.mp4 is not a kind of file that Sidestep knows"),
]


@pytest.mark.parametrize(("words", "message"), DATA, ids=[f"{case[0][0]} {case[1][:30]}" for case in DATA])
def test_bad_data_is_one_line_and_exits_1(door, desk, words, message):
    _, errors = door(words, 1)
    (line,) = [line for line in errors.splitlines() if line.startswith("sidestep: ")]
    assert message in line
    assert not list(desk.glob("x*")) and not list(desk.glob(".x*"))


def test_lack_of_memory_is_said_with_the_fix(door, desk, monkeypatch):
    def full(*_, **__):
        raise RuntimeError(
            "[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory: you tried to allocate"
        )

    monkeypatch.setattr("render.clip.render_frame", full)
    _, errors = door(SHOOT, 1)
    assert "not enough memory for that; give a smaller --size" in errors and not list(desk.glob("x*"))


def test_photos_that_claim_to_be_huge_are_bad_data(door, tmp_path):
    chunk = b"IHDR" + struct.pack(">IIBBBBB", 20_000, 20_000, 8, 2, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    (tmp_path / "walk").mkdir()
    for i in range(3):
        (tmp_path / "walk" / f"{i}.png").write_bytes(data)
    _, errors = door(["recon", str(tmp_path / "walk"), "-o", str(tmp_path / "s1")], 1)
    assert "0.png does not decode as an image" in errors and "fetch the file again" in errors


def test_a_scene_that_another_command_reconstructs_is_left_to_it(door, tmp_path):
    words = ["recon", str(tmp_path), "-o", str(tmp_path / "s1")]
    with sole(tmp_path / "s1"):
        assert "s1 is being written by another command" in door(words, 1)[1]
    assert "not a known layout" in door(words, 1)[1]


def test_pairs_and_trainings_under_way_are_left_alone(door, tmp_path):
    """Pairs are not trained on before all are there: a checkpoint that knows some could not go on with more."""
    pairs, training = tmp_path / "new" / "pairs", tmp_path / "new" / "training"
    (pairs / "s1").mkdir(parents=True)
    make, train = ["pairs", "street", "--data", str(tmp_path), "-o", str(pairs)], ["train", str(pairs), "-o", str(training)]
    train_one = ["train", str(pairs / "s1"), "-o", str(training)]  # of several scenes' pairs, which one command makes
    for held, words in ((pairs, make), (training, train), (pairs, train), (pairs / "s1", train), (pairs, train_one)):
        with sole(held):
            assert f"{held} is being written by another command" in door(words, 1)[1]
    assert not training.exists()
    assert "not a known layout" in door(make, 1)[1]


DEVICE_TAKERS = [
    SHOOT, ["recon", "drive", "-o", "new"], ["pairs", "s1", "--data", "drive", "-o", "pairs"],
    ["enhance", "clip.mp4", "-o", "x.mp4"], ["train", "pairs", "-o", "x"],
]  # fmt: skip


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
@pytest.mark.parametrize("command", DEVICE_TAKERS, ids=lambda command: command[0])
def test_a_device_that_is_not_there_is_refused(door, command):
    assert "leave --device cuda out" in door([*command, "--device", "cuda"], 1)[1]


def test_an_empty_scene_is_refused(door, tmp_path):
    scene = replace(made.street(), background=Placed(Gaussians.empty(), torch.eye(4, dtype=torch.float64)), actors=())
    save(scene, tmp_path / "empty")
    _, errors = door(["render", str(tmp_path / "empty"), *SHOOT[2:]], 1)
    assert "empty is empty" in errors


def test_a_databank_entry_with_a_missing_file_is_named(door, tmp_path):
    shutil.copytree("bank", tmp_path / "bank")
    (tmp_path / "bank" / "assets" / "car" / "0001" / "asset.usdc").unlink()
    _, errors = door([*SHOOT, "--insert", "car/0001@5m,0m", "--databank", str(tmp_path / "bank")], 1)
    assert "asset.usdc" in errors
    assert "car/0001 lacks its file" in door(["validate", str(tmp_path / "bank")], 1)[0]


@pytest.fixture
def spoiled(tmp_path) -> Path:
    """A PLY of ten splats, two of which are not finite."""
    from scenes.formats.ply import save_ply

    splats = made.splats(torch.rand(10, 3, generator=torch.Generator().manual_seed(0)), (0.5, 0.5, 0.5), (0.1, 0.1, 0.1))
    splats.means[3, 1], splats.sh[7] = float("nan"), float("inf")
    save_ply(tmp_path / "a.ply", splats)
    return tmp_path / "a.ply"


def test_nan_in_a_splat_file_is_named_and_refused(door, spoiled):
    out, errors = door(["validate", str(spoiled)], 1)
    assert "splat 3 has nan in means" in out
    assert "problem" in errors
    assert json.loads(door(["info", str(spoiled), "--json"])[0])["invalid_splats"] == 2


def test_nan_is_dropped_and_counted_when_asked(door, spoiled):
    out, _ = door(["validate", str(spoiled), "--drop-invalid"])
    assert "dropped 2 splats" in out and "is valid" in out


def test_nan_is_refused_or_dropped_in_conversion(door, spoiled):
    target = spoiled.with_name("b.spz")
    assert "splat 3 has nan in means" in (errors := door(["convert", str(spoiled), str(target)], 1)[1]) and "--drop-invalid" in errors
    assert not target.exists()
    out, errors = door(["convert", str(spoiled), str(target), "--drop-invalid"])
    assert "dropped 2 splats" in errors and "8 splats" in out


def test_nan_in_a_scene_is_refused_or_dropped(door, tmp_path, monkeypatch):
    shutil.copytree("street", tmp_path / "street")
    splats = made.street().background.gaussians
    splats.log_scales[5] = float("nan")
    save_gaussians(tmp_path / "street" / "background.usdc", splats, made.street().model)
    monkeypatch.chdir(tmp_path)
    words = [*SHOOT, "--size", "32x18", "--duration", "100ms"]
    assert "splat 5" in (errors := door(words, 1)[1]) and "--drop-invalid" in errors
    door([*words, "--drop-invalid"])
    assert "dropped 1 splat with" in json.loads((tmp_path / "x.json").read_text())["warnings"][0]


def test_a_usage_error_names_the_help_of_its_own_command(door):
    for words in (["--label", ""], ["--label", "car", "--scale", "x"], ["--label", "car", "--up", "q"]):
        errors = door(["assets", "add", "car.glb", *words], 2)[1]
        assert "sidestep assets add --help" in errors and words[-2] in errors
    assert "the label is empty" in door(["assets", "add", "car.glb", "--label", " "], 2)[1]
    assert "Did you mean add?" in door(["assets", "ad"], 2)[1]
    assert "extract" in door(["assets"], 2)[1] + door(["assets", "--help"])[0]
