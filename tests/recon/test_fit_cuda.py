"""A fit on a GPU: as good as on the CPU, the same bits again, and on to wherever it is resumed."""

import copy
import os
import signal
from dataclasses import replace

import pytest
import torch
import walker

from recon import open_log, reconstruct
from recon.assemble import assemble
from recon.begin import begin
from recon.checkpoint import load_checkpoint, save_checkpoint
from recon.defaults import choose
from recon.evaluation.report import held_out_table
from recon.fit.config import FitConfig
from recon.fit.fit import Fit

ON_A_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
CONFIG = FitConfig(steps=160, budget=11_000, stages=((0.0, 2), (0.5, 1)), grow_every=6)
SIZE = (96, 54)
WALKED = (112, 64)
"""Of pictures on which walkers are large enough for their stride to be seen."""


def begun(log, device: str, config: FitConfig = CONFIG, start=None, size: tuple[int, int] = SIZE):
    names, span = choose(log, list(log.cameras))
    return begin(log, names, span, size, config, 4, start, device)


def stepped(fit: Fit, until: int = CONFIG.steps) -> Fit:
    while fit.step_count < until:
        fit.step()
    return fit


def leaves(state) -> list[torch.Tensor]:
    """All tensors of a fit's state, on the host."""
    if isinstance(state, torch.Tensor):
        return [state.detach().cpu()]
    parts = state.values() if isinstance(state, dict) else state if isinstance(state, list) else ()
    return [leaf for part in parts for leaf in leaves(part)]


def quality(fit: Fit, start, log) -> float:
    """PSNR of the frames that were held out."""
    rows = held_out_table(assemble(fit, start, log), fit.frames, start.rig)
    return sum(r["psnr"] for r in rows if r["which"] == "all") / len(log.cameras)


@ON_A_GPU
def test_a_fit_on_a_gpu_is_as_good(drive):
    log, found = open_log(drive), {}
    for device in ("cpu", "cuda"):
        start, fit = begun(log, device)
        found[device] = quality(stepped(fit), start, log)
    assert abs(found["cuda"] - found["cpu"]) < 0.8, found  # fits of one device whose sums are rounded otherwise are 0.4 dB apart


@ON_A_GPU
def test_nothing_of_a_fit_is_left_on_the_host_but_poses(drive):
    fit = stepped(begun(open_log(drive), "cuda")[1], 3)
    state = fit.tensors()
    there = [*state["fields"].values(), state["reach"], *state["growth"].values(), *state["descent"].values(), state["sky"]]
    assert {t.device.type for t in [*there, state["exposures"], fit.training[0].image, fit.training[0].sky]} == {"cuda"}
    assert {t.device.type for t in state["motion"].values()} == {"cpu"}


@ON_A_GPU
@pytest.mark.parametrize("drop", [0.0, 0.2])
def test_the_same_fit_on_a_gpu_is_the_same_bits(drive, drop):
    log = open_log(drive)
    first, second = (stepped(begun(log, "cuda", replace(CONFIG, drop=drop))[1]) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(leaves(first.tensors()), leaves(second.tensors()), strict=True))


@ON_A_GPU
def test_walkers_fitted_on_a_gpu_are_the_same_bits_and_walk():
    log = walker.log_of(walker.walk(24, *WALKED))
    first, second = (stepped(begun(log, "cuda", replace(CONFIG, steps=60), size=WALKED)[1], 60) for _ in range(2))
    assert first.limbs.of and all(limb.deformation() is not None for limb in first.limbs.of.values())
    assert all(torch.equal(a, b) for a, b in zip(leaves(first.tensors()), leaves(second.tensors()), strict=True))


@ON_A_GPU
@pytest.mark.parametrize(("here", "there"), [("cuda", "cpu"), ("cpu", "cuda")])
def test_a_checkpoint_moves_between_devices(drive, tmp_path, here, there):
    log = open_log(drive)
    start, fit = begun(log, here)
    stepped(fit, 80)
    save_checkpoint(tmp_path / "s.fit", {}, start, fit.tensors())
    stayed = quality(stepped(fit), start, log)
    saved, state = load_checkpoint(tmp_path / "s.fit", {})
    start, moved = begun(log, there, start=saved)
    moved.restore(state)
    assert moved.step_count == 80 and moved.splats.reach.device.type == there
    assert abs(quality(stepped(moved), start, log) - stayed) < 0.3


@ON_A_GPU
def test_an_interrupted_fit_on_a_gpu_goes_on_bit_by_bit(drive, tmp_path, monkeypatch):
    log, step = open_log(drive), Fit.step
    whole = reconstruct(log, tmp_path / "whole", size=SIZE, held_out=4, config=CONFIG, device="cuda")

    def interrupted(self):
        if self.step_count == 95:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self)

    monkeypatch.setattr(Fit, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(log, tmp_path / "s", size=SIZE, held_out=4, config=CONFIG, device="cuda")
    monkeypatch.setattr(Fit, "step", step)
    resumed = reconstruct(log, tmp_path / "s", size=SIZE, held_out=4, config=CONFIG, resume=True, device="cuda")
    for name, tensor in resumed.background.gaussians.tensors().items():
        assert tensor.device.type == "cpu" and torch.equal(tensor, getattr(whole.background.gaussians, name)), name
    assert resumed.meta["held_out"] == whole.meta["held_out"] and resumed.meta["off_path"] == whole.meta["off_path"]


def test_what_is_restored_is_what_was_kept(drive, tmp_path):
    log = open_log(drive)
    start, fit = begun(log, "cpu")
    stepped(fit, 12)
    save_checkpoint(tmp_path / "s.fit", {}, start, fit.tensors())
    kept = copy.deepcopy(fit.tensors())
    again_start, state = load_checkpoint(tmp_path / "s.fit", {})
    again = begun(log, "cpu", start=again_start)[1]
    again.restore(state)
    assert all(torch.equal(a, b) for a, b in zip(leaves(kept), leaves(again.tensors()), strict=True))
