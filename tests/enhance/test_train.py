"""Training: repeatable, resumable, and downhill."""

import os
import signal
import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_net import SMALL

from enhance.enhancer import Enhancer
from enhance.evaluate import ALL_TOLD, ALONE, METHODS, PUT_IN, _told, evaluate, table
from enhance.network.net import Net, NetConfig
from enhance.network.weights_file import BUILTIN, load_net
from enhance.pairs.shards import PairSet, to_bytes, write_shard
from enhance.training.run import STAGES, Run, TrainConfig, opened
from enhance.training.train import _Reporter, train
from render.frame_types import Frame
from scenes.camera import Camera
from scenes.lenses import Pinhole
from scenes.state import save_state

ON_A_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
DEVICES = ["cpu", pytest.param("cuda", marks=ON_A_GPU)]
QUICK = TrainConfig(crop=32, images=2, clips=1, frames=2, looked_at=2)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pairs")
    y, x = torch.meshgrid(torch.linspace(0, 6, 40), torch.linspace(0, 9, 56), indexing="ij")
    for kind in ("underfit", "isp", "clean"):
        target = torch.stack([torch.stack([x.sin(), (x + t).cos(), y.sin()], -1) * 0.4 + 0.5 for t in (0, 0.1, 0.2)])
        region = torch.zeros(3, 40, 56)
        region[:, 10:30, 10:40] = float(kind != "clean")
        damage = {"underfit": 0.15, "isp": 0.2 * region[..., None], "clean": 0.0}[kind]
        flow = torch.zeros(3, 40, 56, 2, dtype=torch.float16)
        flow[0] = torch.nan
        tensors = {
            "input": to_bytes(target + damage),
            "target": to_bytes(target),
            "region": to_bytes(region),
            "instance": region.to(torch.uint8),
            "flow": flow,
            "visible": torch.ones(3, 40, 56, dtype=torch.uint8),
            "depth": torch.ones(3, 40, 56, dtype=torch.float16),
        }
        for i, split in enumerate(("train", "held out")):
            changed = {"instances": [1]} if kind == "isp" else {}
            write_shard(folder / kind / f"{i}.safetensors", tensors, {"kind": kind, "split": split, **changed})
    return PairSet(folder)


@pytest.mark.parametrize(("stopped", "ends"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)])
def test_a_run_in_two_halves_equals_an_unbroken_one(pairs, tmp_path, monkeypatch, stopped, ends):
    torch.set_num_threads(1)
    whole = train(pairs, tmp_path / "whole", steps=12, seed=3, config=QUICK, net=SMALL)

    module, steps = sys.modules["enhance.training.train"], []
    step = module.enhancer_step

    def stop(*arguments):
        steps.append(1)
        if len(steps) == 3:
            os.kill(os.getpid(), stopped)
        return step(*arguments)

    monkeypatch.setattr(module, "enhancer_step", stop)
    with pytest.raises(ends):
        train(pairs, tmp_path / "halves", steps=12, seed=3, config=QUICK, net=SMALL)
    monkeypatch.undo()
    assert len(steps) == opened(tmp_path / "halves" / "checkpoint.pt")["step"]["enhancer"] == 3
    halves = train(pairs, tmp_path / "halves", steps=12, seed=3, config=QUICK, net=SMALL, resume=True)
    first, second = load_net(whole)[0].state_dict(), load_net(halves)[0].state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_an_unfinished_training_is_not_overwritten(pairs, tmp_path):
    (tmp_path / "checkpoint.pt").write_bytes(b"something")
    with pytest.raises(FileExistsError, match="--resume"):
        train(pairs, tmp_path, steps=4, config=QUICK, net=SMALL)
    with pytest.raises(ValueError, match="not a checkpoint"):
        train(pairs, tmp_path, steps=4, config=QUICK, net=SMALL, resume=True)


def test_a_training_that_is_not_there_is_not_gone_on_with(pairs, tmp_path):
    with pytest.raises(FileNotFoundError, match="nothing to resume: .*typo/checkpoint.pt does not exist"):
        train(pairs, tmp_path / "typo", steps=4, config=QUICK, net=SMALL, resume=True)
    assert not (tmp_path / "typo").exists()


@pytest.mark.parametrize("budget", [{}, {"steps": 3, "minutes": 1}, {"steps": 0}, {"minutes": -1}])
def test_the_budget_is_one_positive_number(pairs, tmp_path, budget):
    with pytest.raises(ValueError, match="budget"):
        train(pairs, tmp_path, **budget)
    with pytest.raises(ValueError, match=r"positive, got 0\.0"):
        train(pairs, tmp_path, minutes=0.0)


@pytest.mark.parametrize("device", DEVICES)
def test_training_undoes_a_constant_error(pairs, tmp_path, device):
    config = replace(QUICK, autoencoder=0.05, objects=0.01, rate=3e-3, kinds=("underfit", "isp", "clean"))
    weights = train(pairs, tmp_path, steps=400, config=config, net=SMALL, device=device)
    rows = evaluate(pairs, Enhancer.load(weights, device))
    assert [r.method for r in rows] == [*METHODS, ALONE, ALL_TOLD, *METHODS, PUT_IN, *METHODS]
    by = {(r.kind, r.method): r for r in rows}
    assert by["underfit", "ours"].mean("region") > by["underfit", "identity"].mean("region") + 0.3
    assert by["clean", "identity"].mean("frame") == float("inf") and by["isp", "identity"].mean("warp error") > 0
    text = table(rows)
    assert text.count("\n") == 13 and "| clean | identity | - | - | equal |" in text
    gained = by["underfit", "ours"].mean("region") - by["underfit", "identity"].mean("region")
    assert f" | {gained:+.2f} | " in text, "of a single clip without an interval"


def test_trained_weights_are_trained_further_with_their_autoencoder(pairs, tmp_path):
    first = train(pairs, tmp_path / "first", steps=6, config=QUICK, net=SMALL)
    second = train(pairs, tmp_path / "second", steps=4, config=QUICK, start=first)
    (before, _), (after, about) = load_net(first), load_net(second)
    assert after.config == before.config and about["steps"]["autoencoder"] == 0 and about["further"]["seed"] == 0
    for name, value in before.state_dict().items():
        same = torch.equal(after.state_dict()[name], value)
        assert same if name.startswith("encoder.") else not (same and name == "decoder.pixels.weight"), name


@ON_A_GPU
@pytest.mark.parametrize(("first", "second"), [("cpu", "cuda"), ("cuda", "cpu")])
def test_a_training_goes_on_on_another_device(pairs, tmp_path, first, second):
    def trained(name: str, devices: tuple[str, str]) -> Path:
        train(pairs, tmp_path / name, steps=10, config=QUICK, net=SMALL, device=devices[0])
        return train(pairs, tmp_path / name, steps=20, config=QUICK, net=SMALL, device=devices[1], resume=True)

    net, about = load_net(trained("moved", (first, second)))
    assert about["steps"] == load_net(trained("stayed", ("cpu", "cpu")))[1]["steps"]
    assert all(value.isfinite().all() for value in net.state_dict().values())


@ON_A_GPU
def test_weights_trained_on_a_gpu_make_the_same_picture_on_a_cpu(pairs, tmp_path):
    weights = train(pairs, tmp_path, steps=60, config=replace(QUICK, rate=3e-3), net=SMALL, device="cuda")
    here, there = (Enhancer.load(weights, device, bfloat16=False, repair=True) for device in ("cpu", "cuda"))
    window, memories = pairs.of("underfit", "held out")[0].window(), [None, None]
    for rgb in window.input.permute(0, 2, 3, 1):
        (one, memories[0]), (other, memories[1]) = here.step(rgb, memories[0]), there.step(rgb, memories[1])
        assert not torch.equal(one, rgb)
        assert (one - other.cpu()).abs().max() < 4 / 255  # convolutions on a GPU round to 10 bits (TF32)


@ON_A_GPU
def test_told_objects_are_corrected_alike_on_a_gpu():
    y, x = torch.meshgrid(torch.linspace(0, 6, 96), torch.linspace(0, 9, 160), indexing="ij")
    rgb, ids = torch.stack([x.sin(), (x + y).cos(), y.sin()], -1) * 0.4 + 0.5, torch.zeros(96, 160, dtype=torch.int32)
    ids[30:70, 40:100] = 1
    rgb[ids > 0] *= 0.6
    flat = Pinhole(1.0, 1.0, 80, 48)
    frame = Frame(Camera(flat, 160, 96, torch.eye(4, dtype=torch.float64)), rgb=rgb, instance=ids)
    one, other = (Enhancer.load("builtin", device, bfloat16=False).step(frame)[0].cpu() for device in ("cpu", "cuda"))
    assert not torch.equal(one, rgb) and (one - other).abs().max() < 2 / 255


def test_a_loss_that_is_not_finite_ends_a_training_before_it_is_saved(pairs, trained, monkeypatch):
    kept = (trained / "checkpoint.pt").read_bytes()
    monkeypatch.setattr(sys.modules["enhance.training.stages"], "pixel_loss", lambda *_: torch.tensor(torch.nan, requires_grad=True))
    with pytest.raises(ValueError, match="enhancer's loss is nan"):
        train(pairs, trained, steps=4, config=QUICK, net=SMALL, resume=True)
    assert (trained / "checkpoint.pt").read_bytes() == kept


def test_a_loss_is_known_after_a_resume_and_not_said_where_it_is_not(pairs, trained):
    def reported(run: Run) -> str:
        lines: list[str] = []
        _Reporter(run, lambda share, line: lines.append(line))("enhancer")
        return lines[0]

    checkpoint = trained / "checkpoint.pt"
    state = opened(checkpoint)
    run = Run(QUICK, Net(SMALL), None, 3, 0, STAGES, told=state["told"])
    assert reported(run) == "enhancer: step 0" and set(state["loss"]) == {stage for stage, steps in state["step"].items() if steps}
    run.load(checkpoint)
    assert run.loss("enhancer") == state["loss"]["enhancer"] > 0
    assert reported(run) == f"enhancer: step {state['step']['enhancer']}, loss {state['loss']['enhancer']:.4f}"
    former = trained.parent / "former.pt"
    save_state(former, {name: part for name, part in state.items() if name != "loss"})
    run.load(former)
    assert run.loss("enhancer") is None


def test_a_gpu_gets_larger_batches_and_a_cpu_what_it_had():
    cpu, cuda = (TrainConfig.of(torch.device(name)) for name in ("cpu", "cuda"))
    assert cpu == TrainConfig() and cuda.images > cpu.images and cuda.crop == cpu.crop


@pytest.fixture(scope="module")
def trained(pairs, tmp_path_factory):
    """The folder of a short training."""
    return train(pairs, tmp_path_factory.mktemp("trained"), steps=3, config=QUICK, net=SMALL).parent


@pytest.mark.parametrize("fault", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_disk_that_fills_and_a_stop_in_the_middle_of_saving_lose_nothing(pairs, trained, monkeypatch, fault):
    kept, before = (trained / "checkpoint.pt").read_bytes(), sorted(trained.iterdir())
    save = torch.save

    def half(state, file):
        save({"step": state["step"]}, file)
        raise fault

    monkeypatch.setattr(torch, "save", half)
    with pytest.raises(type(fault)):
        train(pairs, trained, steps=4, config=QUICK, net=SMALL, resume=True, save_every=0)
    monkeypatch.undo()
    assert (trained / "checkpoint.pt").read_bytes() == kept and sorted(trained.iterdir()) == before
    train(pairs, trained, steps=3, config=QUICK, net=SMALL, resume=True)


@pytest.mark.skipif(not Path("/dev/full").is_char_device(), reason="needs /dev/full, a disk that is always full")
def test_a_full_disk_is_called_that(pairs, trained, monkeypatch):
    @contextmanager
    def full(path):
        yield Path("/dev/full")

    monkeypatch.setattr(sys.modules["scenes.state"], "atomic_file", full)
    with pytest.raises(OSError, match="No space left"):
        train(pairs, trained, steps=3, config=QUICK, net=SMALL, resume=True)


def test_a_disk_that_fills_while_it_is_written_to_is_called_that_and_the_file_named(pairs, trained, monkeypatch):
    class Filling:
        left = 1000

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def write(self, some):
            self.left -= len(some)
            if self.left < 0:
                raise OSError(28, "No space left on device")
            return len(some)

        def flush(self):
            pass

    monkeypatch.setattr(sys.modules["scenes.state"], "open", lambda *_: Filling(), raising=False)
    with pytest.raises(OSError, match="No space left") as full:
        train(pairs, trained, steps=3, config=QUICK, net=SMALL, resume=True)
    assert full.value.errno == 28 and full.value.filename == str(trained / "checkpoint.pt")
    (note,) = full.value.__notes__
    assert note == f"it takes {(trained / 'checkpoint.pt').stat().st_size / 1e6:.1f} MB"


@pytest.mark.parametrize("spoil", [lambda b: b[: len(b) // 2], lambda b: b"not a checkpoint", lambda b: b""])
def test_a_broken_checkpoint_is_refused_by_name(pairs, trained, tmp_path, spoil):
    (tmp_path / "checkpoint.pt").write_bytes(spoil((trained / "checkpoint.pt").read_bytes()))
    with pytest.raises(ValueError, match="checkpoint.pt is not a checkpoint of this training"):
        train(pairs, tmp_path, steps=3, config=QUICK, net=SMALL, resume=True)


def test_a_rollout_of_clean_pairs_is_told_its_objects(pairs):
    frames = _told(pairs.of("clean", "held out"))
    assert len(frames) == 3 and all(f.instance.max() == 0 and f.flow_prev is None for f in frames)


def test_enhancers_beside_ours_are_rows_of_their_own(pairs):
    class Told:
        about, device, reads = {}, torch.device("cpu"), ("instance",)

        def step(self, frame, memory=None):
            assert frame.instance is not None and (memory is None) == (frame.flow_prev is None)
            return frame.rgb * 0.5, True

    rows = evaluate(pairs, Enhancer(Net(SMALL)), beside={"half": Told()})
    assert [r.method for r in rows] == [*METHODS, ALONE, ALL_TOLD, "half", *METHODS, PUT_IN, "half", *METHODS, "half"]
    assert all(r.mean("frame") < 20 for r in rows if r.method == "half") and "| isp | half |" in table(rows)


def test_what_is_learnt_of_objects_is_kept_before_it_is_asked_what_changes_are_usual(pairs, tmp_path, monkeypatch):
    """That takes minutes, says how far it is, can be stopped, and comes out the same where it begins anew."""
    monkeypatch.setattr(sys.modules["enhance.training.train"], "USUAL", 60)
    only = {"steps": 4, "config": QUICK, "start": "builtin", "only": ("objects",)}
    whole = train(pairs, tmp_path / "whole", **only)

    lines, now = [], sys.modules["enhance.training.train"].time
    monkeypatch.setattr(now, "monotonic", iter(range(0, 10**9, 10)).__next__)

    def stop(share, line):
        lines.append(line)
        if "changes on 3" in line:
            assert opened(tmp_path / "halves" / "checkpoint.pt")["step"]["objects"] == 4
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train(pairs, tmp_path / "halves", **only, progress=stop, save_every=10**6)
    assert "measured the usual changes on" in lines[-1]
    monkeypatch.undo()
    monkeypatch.setattr(sys.modules["enhance.training.train"], "USUAL", 60)
    halves = train(pairs, tmp_path / "halves", **only, resume=True)
    first, second = load_net(whole)[0].objects.usual, load_net(halves)[0].objects.usual
    assert torch.equal(first, second) and not torch.equal(first, load_net(BUILTIN)[0].objects.usual)


def test_a_longer_budget_begins_no_stage_anew_that_a_later_one_stands_on(pairs, tmp_path, capsys):
    """What the autoencoder and the prior learn is lost on a network that was trained on theirs."""
    first = train(pairs, tmp_path, steps=20, net=SMALL, config=QUICK)
    shorter = opened(tmp_path / "checkpoint.pt")["step"]
    assert "clips that are held out repairs gain" in capsys.readouterr().err
    train(pairs, tmp_path, steps=60, net=SMALL, config=QUICK, resume=True)
    longer = opened(tmp_path / "checkpoint.pt")["step"]
    assert first.is_file() and longer["enhancer"] > shorter["enhancer"] > 0
    assert all(longer[stage] == shorter[stage] for stage in ("autoencoder", "prior", "objects"))


def test_clips_shorter_than_what_is_looked_back_to_are_said_and_trained_on(pairs, tmp_path, capsys):
    train(pairs, tmp_path, steps=12, net=SMALL, config=replace(QUICK, frames=9))
    assert "the longest training clip has 3 of 9 frames" in capsys.readouterr().err


def test_a_clip_is_as_long_as_the_network_looks_back():
    assert TrainConfig().frames == NetConfig().history + 1
