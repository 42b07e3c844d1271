"""Every command that takes a device, on a GPU: on a real one, and where there is none, in a process that pretends to have one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import street as made
import torch
from made_drive import write_drive

import sidestep
from enhance.evaluate import main as evaluate
from enhance.pairs.shards import PairSet
from enhance.training.train import TrainConfig, train
from recon import open_log, reconstruct
from recon.fit.config import FitConfig
from render.outputs import OUTPUTS
from render.video import read_image, read_video
from scenes import Databank

REPOSITORY = Path(__file__).parents[1]
ON_A_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
CONFIG = FitConfig(steps=24, budget=6_000, stages=((0.0, 2), (0.5, 1)), grow_every=6)
CAMERAS = ("front_camera", "left_camera")
SHOT = ["--camera", "front_camera", "--lateral-shift", "50cm", "--duration", "300ms", "--size", "96x54", "--databank", "bank"]
CARS = ["--insert", "car/0001@9m,2.5m", "--insert", "van/0001@7m,-3m,yaw=5deg,speed=8m/s"]


@pytest.fixture(scope="module")
def desk(tmp_path_factory) -> Path:
    """A folder with a drive, the scene that a GPU fits to it, cars."""
    folder = tmp_path_factory.mktemp("desk")
    drive = write_drive(folder / "drive", made.street())
    reconstruct(open_log(drive), folder / "scene", CAMERAS, size=(96, 54), held_out=4, config=CONFIG, device="cuda")
    bank = Databank(folder / "bank")
    bank.add(made.car())
    bank.add(made.car("van", (0.8, 0.8, 0.2)))
    return folder


def call(desk: Path, monkeypatch, *words: str) -> None:
    monkeypatch.chdir(desk)
    sidestep.main(list(words))


def pictures(clip: Path) -> torch.Tensor:
    """`[T, H, W, 3]`."""
    return torch.stack(list(read_video(clip)))


def shoot(desk: Path, monkeypatch, *words: str) -> list[torch.Tensor]:
    """The same clip by CPU and GPU."""
    clips = []
    for device in ("cpu", "cuda"):
        call(desk, monkeypatch, "render", "scene", *SHOT, *words, "-o", f"{device}.mp4", "-w", "--device", device)
        clips.append(pictures(desk / f"{device}.mp4"))
    return clips


@ON_A_GPU
def test_render_with_all_outputs(desk, monkeypatch):
    shoot(desk, monkeypatch, *CARS, "--outputs", ",".join(set(OUTPUTS) - {"features"}))
    # frame by frame: of one and the same clip x264 makes videos that are more than that apart, now and then
    named = [sorted((desk / device / "rgb").glob("*.png")) for device in ("cpu", "cuda")]
    here, there = (torch.stack([read_image(picture) for picture in pictures]) for pictures in named)
    assert (here - there).abs().mean() < 1 / 255


@ON_A_GPU
def test_render_enhanced_with_photos(desk, monkeypatch):
    here, there = shoot(desk, monkeypatch, *CARS, "--enhance")
    assert (here - there).abs().mean() < 2 / 255


@ON_A_GPU
def test_pairs_training_and_evaluation(desk, monkeypatch):
    kinds = "isp,clean,relight,shadow,isp_frame"
    made_of = ["scene", "--data", "drive", "--databank", "bank", "--kinds", kinds, "--size", "96"]
    call(desk, monkeypatch, "pairs", *made_of, "-o", "pairs", "--device", "cuda")
    assert {shard.meta["kind"] for shard in PairSet(desk / "pairs").shards} == set(kinds.split(","))
    config = TrainConfig(images=1, crop=48)
    weights = train(PairSet(desk / "pairs"), desk / "training", steps=12, config=config, start="builtin", device="cuda")
    assert evaluate([str(desk / "pairs"), "--weights", str(weights), "--device", "cuda", "--limit", "1"]) == 0


@ON_A_GPU
def test_a_video_enhanced(desk, monkeypatch):
    call(desk, monkeypatch, "render", "scene", *SHOT, "-o", "clip.mp4", "-w")
    call(desk, monkeypatch, "enhance", "clip.mp4", "-o", "clean.mp4", "--rendered", "--like", "clip.mp4", "--device", "cuda")
    assert pictures(desk / "clean.mp4").shape == pictures(desk / "clip.mp4").shape


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU, on which all this ran")
def test_all_of_it_where_a_gpu_is_pretended():
    run = subprocess.run(
        [sys.executable, "-m", "tests.pretend_cuda", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "tests/test_gpu.py"],
        cwd=REPOSITORY, env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0 and " passed, 1 skipped" in run.stdout, run.stdout[-6000:]
