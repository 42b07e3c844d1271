from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from recon import open_log, reconstruct
from recon.begin import begin
from recon.defaults import choose
from recon.evaluation.live import EVERY, Live
from recon.evaluation.report import EQUAL_DB
from recon.fit.config import FitConfig

CONFIG = FitConfig(steps=4 * EVERY, budget=9000, stages=((0.0, 2), (0.5, 1)), grow_every=10)
SIZE = (96, 54)


def made(drive, config=CONFIG):
    log = open_log(drive)
    return begin(log, *choose(log), SIZE, config, held_out=3)[1]


def test_who_looks_changes_nothing(drive):
    alone, watched = made(drive), made(drive)
    live = Live(watched)
    for step in range(EVERY + 5):
        alone.step()
        watched.step()
        watched.picture(watched.frames.held_out()[step % 2])
        live.look(watched, 0.0)
    assert str(live).startswith("held out ")
    for name, field in alone.splats.fields.items():
        assert torch.equal(field, watched.splats.fields[name]), name
    assert torch.equal(alone.generator.get_state(), watched.generator.get_state())


def test_the_live_figure_is_that_of_the_finished_scene(drive, tmp_path, capfd):
    config = replace(CONFIG, steps=20 * EVERY)  # at half of these a fit still gains 0.7 dB from a look to the next
    scene = reconstruct(open_log(drive), tmp_path / "s", size=SIZE, held_out=4, config=config)
    step, seconds, decibels = scene.meta["fit"]["live"][-1]
    row = next(r for r in scene.meta["held_out"] if r["which"] == "all")
    assert step == config.steps and 0 < seconds <= scene.meta["fit"]["seconds"]
    # the last look at one of the two pictures is EVERY steps old, and a scene's camera stands on the path's knots
    assert decibels == pytest.approx(row["psnr"], abs=0.7)
    assert f"held out {decibels:.2f} dB" in capfd.readouterr().err
    figures = [d for _, _, d in scene.meta["fit"]["live"]]
    assert len(figures) >= 2 and figures[-1] > figures[0]


def test_a_fit_that_holds_nothing_out_says_nothing(drive):
    log = open_log(drive)
    fit = begin(log, *choose(log), SIZE, CONFIG, held_out=0)[1]
    live = Live(fit)
    fit.step_count = EVERY
    live.look(fit, 1.0)
    assert str(live) == "" and not live.curve


def test_an_interrupted_curve_goes_on(drive):
    fit = made(drive)
    live = Live(fit, [[25, 1.0, 20.0]])
    for fit.step_count in range(1, 3 * EVERY + 1):
        live.look(fit, 2.0)
    assert live.curve[0] == [25, 1.0, 20.0] and [row[0] for row in live.curve] == [25, 2 * EVERY]
    seen = [fit.picture(view) for view in live.views]
    shown = np.mean([float(-10 * (s - v.image / 255).square().mean().log10()) for s, v in zip(seen, live.views, strict=True)])
    assert live.curve[-1][2] == pytest.approx(shown, abs=0.02)


def test_pictures_that_are_all_alike_have_figures_that_a_scene_can_keep(own_drive, tmp_path):
    for file in own_drive.glob("camera/*/*.jpg"):
        Image.new("RGB", SIZE).save(file)  # the lens cap was on: nothing is easier
    scene = reconstruct(open_log(own_drive), tmp_path / "s", size=SIZE, held_out=4, config=replace(CONFIG, steps=EVERY))
    assert [row["mean_psnr"] for row in scene.meta["held_out"]] == [EQUAL_DB] * len(scene.meta["held_out"])
    assert all(0 < row["psnr"] <= EQUAL_DB for row in scene.meta["held_out"])


def test_what_is_the_recording_car_does_not_count(drive):
    fit = made(drive)
    ego = torch.zeros(SIZE[1], SIZE[0], dtype=torch.bool)
    ego[40:] = True
    red = torch.tensor([255, 0, 0], dtype=torch.uint8)
    live = Live(fit)
    fit.frames = replace(fit.frames, views=[replace(v, ego=ego, image=torch.where(ego[..., None], red, v.image)) for v in fit.frames.views])
    masked = Live(fit)
    for fit.step_count in (EVERY, 2 * EVERY):
        live.look(fit, 0.0)
        masked.look(fit, 0.0)
    assert abs(live._mean() - masked._mean()) < 3
