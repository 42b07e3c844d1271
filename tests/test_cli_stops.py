"""Commands that are stopped, or run out of disk, leave nothing half done."""

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import street as made
from front_door import environment

from scenes import load, save
from scenes.stops import stopped_saying


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


@pytest.mark.parametrize(("code", "fix"), [(errno.ENOSPC, "; make room there"), (errno.EDQUOT, "; make room there"), (errno.EFBIG, "")])
def test_the_fix_of_a_full_disk_is_told_with_how_it_goes_on(door, tmp_path, monkeypatch, code, fix):
    def full(*_, **__):
        with stopped_saying(lambda: "give the command again"):
            raise OSError(code, os.strerror(code), "s1.fit")

    monkeypatch.setattr("scenes.commands.Info.run", full)
    assert door(["info", "street"], 1)[1] == f"sidestep: s1.fit: {os.strerror(code)}{fix}; give the command again\n"


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
