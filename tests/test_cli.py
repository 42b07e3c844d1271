"""The front door as a user meets it: separate processes where exit codes and output count, small scenes everywhere."""

import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import street as made
import torch

from render.video import VideoWriter, read_video
from scenes import Databank, Gaussians, Placed, SplatModel, load, save
from scenes.convert import stood_up
from scenes.usd.splats import save_gaussians

REPOSITORY = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def desk(tmp_path_factory) -> Path:
    """A folder with a scene, a databank and a clip; read-only by agreement."""
    folder = tmp_path_factory.mktemp("desk")
    save(made.street(), folder / "street")
    bank = Databank(folder / "bank")
    bank.add(made.car())
    bank.add(made.car("van", (0.8, 0.8, 0.2)))
    with VideoWriter(folder / "clip.mp4", 10, 64, 48) as video:
        for _ in range(3):
            video.write(torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(1)))
    return folder


def sidestep(folder: Path, *words: str, code: int = 0) -> subprocess.CompletedProcess:
    """Run the command line in a folder and check its exit code; never a traceback."""
    run = subprocess.run([sys.executable, "-m", "sidestep", *words], cwd=folder, env=environment(), capture_output=True, text=True)
    assert run.returncode == code, run.stderr
    assert "Traceback" not in run.stderr
    return run


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(REPOSITORY), "COLUMNS": "400"}


@pytest.fixture
def door(desk, monkeypatch, capsys):
    """Call the front door in this process, which has its packages loaded: (words, exit code) -> (stdout, stderr)."""
    import sidestep as front

    monkeypatch.chdir(desk)
    monkeypatch.setenv("COLUMNS", "400")
    before = signal.getsignal(signal.SIGTERM)

    def call(words: list[str], code: int = 0) -> tuple[str, str]:
        try:
            front.main(words)
            ended = 0
        except SystemExit as end:
            ended = end.code
        out, errors = capsys.readouterr()
        assert ended == code, errors
        return out, errors

    yield call
    signal.signal(signal.SIGTERM, before)


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


@pytest.mark.parametrize(
    ("command", "last"),
    [(["insert", "--asset", "car/0001", "--at", "20m,-3.5m"], "scenes.seen.unseen_warning"),
     (["edit", "--shift", "veh_1=0m,1m"], "scenes.edit.absences")],
)  # fmt: skip
def test_who_stops_while_it_is_found_out_what_to_warn_of_has_changed_nothing(door, tmp_path, monkeypatch, command, last):
    shutil.copytree("street", tmp_path / "street")

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(last, stopped)
    _, errors = door([command[0], str(tmp_path / "street"), *command[1:], "--databank", "bank"], 130)
    assert errors == "sidestep: interrupted\n"
    assert "edits" not in load(tmp_path / "street").meta and not list((tmp_path / "street" / "edits").iterdir())


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
    assert "--forward, or --force" in door([*add, "--up", "y", "--forward", "x"], 1)[1]
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


SHOOT = ["render", "street", "--camera", "front_camera", "-o", "x.mp4"]
INSERT = ["insert", "street", "--asset", "car/0001"]
USAGE = [
    (["rendr"], 'command "rendr" is not in sidestep; it has recon, assets,', "Did you mean render?"),
    ([*SHOOT, "--lateral-shift", "2"], "--lateral-shift", '"2" has no unit; write 2m (metres) or 200cm'),
    ([*SHOOT, "--lateral-shift", "2deg"], "--lateral-shift", "an angle, not a length"),
    ([*SHOOT, "--start", "3"], "--start", '"3" has no unit; write 3s (seconds) or 3000ms'),
    ([*SHOOT, "--size", "640"], "--size", "as 640x360"),
    ([*SHOOT, "--outputs", "dept"], "--outputs", "Did you mean depth?"),
    ([*SHOOT, "--insert", "car/0001"], "--insert", "write ID@X,Y"),
    ([*SHOOT, "--size", "100000x9"], "--size", "at most 16384 pixels a side"),
    ([*SHOOT, "--fps", "0"], "--fps", "write frames a second, above 0 and below 1000, as 10"),
    (["render", "street/background.usdc", *SHOOT[4:], "--insert", "car/1@5m,0m"], "--insert needs a scene", "usdc holds splats only"),
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


def test_a_usage_error_names_the_help_of_its_own_command(door):
    for words in (["--label", ""], ["--label", "car", "--scale", "x"], ["--label", "car", "--up", "q"]):
        errors = door(["assets", "add", "car.glb", *words], 2)[1]
        assert "sidestep assets add --help" in errors and words[-2] in errors
    assert "the label is empty" in door(["assets", "add", "car.glb", "--label", " "], 2)[1]
    assert "Did you mean add?" in door(["assets", "ad"], 2)[1]
    assert "extract" in door(["assets"], 2)[1] + door(["assets", "--help"])[0]


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


@pytest.mark.parametrize(
    "words",
    ["recon", "assets extract", "assets add", "assets list", "assets show", "assets check", "insert", "edit", "render", "pairs", "train",
     "enhance", "convert", "info", "validate", "doctor", "demo"],
)  # fmt: skip
def test_help_speaks_of_values_as_they_are_written(door, words):
    """Not as Python has them: {None}|STR is nothing that can be typed."""
    told = door([*words.split(), "--help"], 0)[0]
    assert "--" in told and "None" not in told and "STR]" not in told


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


def begin(folder: Path, desk: Path) -> subprocess.Popen:
    """Start a long render and wait until it writes."""
    words = ["render", str(desk / "street"), "--camera", "front_camera", "--size", "320x180", "--fps", "500", "-o", "out.mp4"]
    # who runs the tests in the background of a script has Ctrl-C ignored, and so would they
    heeding = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from sidestep import main; main()"
    command = [sys.executable, "-c", heeding, *words]
    process = subprocess.Popen(command, cwd=folder, env=environment(), stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not any(p.name.startswith(".out") for p in folder.iterdir()):
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.05)
    return process


@pytest.mark.parametrize(("stop", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)])
def test_a_stopped_render_leaves_no_half_file_under_the_final_name(desk, tmp_path, stop, code):
    process = begin(tmp_path, desk)
    time.sleep(0.3)
    process.send_signal(stop)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == code, errors
    assert "Traceback" not in errors
    left = [p.name for p in tmp_path.iterdir()]
    assert "out.mp4" not in left and "out.json" not in left
    if stop != signal.SIGKILL:
        assert left == []
    if stop == signal.SIGINT:
        assert "sidestep: interrupted" in errors


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["render", "{}/street", "--size", "320x180", "-o", "out.mp4"], "out.mp4: File too large"),
        (["render", "{}/street", "--size", "64x36", "-o", "out.mp4", "--outputs", "depth"], "out.mp4: File too large"),  # beside the frames
        (["convert", "{}/bank/assets/car/0001/asset.usdc", "a.splat"], "a.splat: File too large"),
        (["assets", "add", "{}/car.ply", "--label", "car", "--up=z", "--forward=x"], "databank/assets/car/0001/asset.usdc: "),
    ],
    ids=["video", "arrays", "splats", "asset"],
)
def test_a_full_disk_leaves_no_half_file_and_is_told(desk, tmp_path, words, told):
    """A limit on the size of files stands in for the disk: the write fails in the middle."""
    if not (desk / "car.ply").exists():
        save(made.car().gaussians, desk / "car.ply")
    code = "import resource, sys, signal, sidestep; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
    code += "resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000)); sidestep.main(sys.argv[1:])"
    words = [word.format(desk) for word in words]
    run = subprocess.run([sys.executable, "-c", code, *words], cwd=tmp_path, env=environment(), capture_output=True, text=True)
    assert run.returncode == 1, run.stderr
    assert "Traceback" not in run.stderr and f"sidestep: {told}" in run.stderr
    assert os.listdir(tmp_path) == []
