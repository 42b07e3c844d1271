import math
import os
import signal
import sys
import time
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from recon import open_log, reconstruct, stopped_early
from recon.actors import split_points
from recon.build import _span, assemble, begin, choose
from recon.checkpoint import checkpoint_path, load_checkpoint, save_checkpoint
from recon.commands import Recon
from recon.corrected import REMOUNTED, TURNED, as_corrected, moved
from recon.fit.config import FitConfig
from recon.fit.fit import BLAME_EVERY, Fit
from recon.fit.model import Knots, Splats, small_poses
from recon.fit.openings import ASIDE_WEIGHT, HORIZON
from recon.fit.swept import Swept
from recon.fit.turns import Turns
from recon.log import LogCamera
from recon.memory import check_memory
from recon.seeds.measured import Measured, by_lidar, by_lidar_of_movers, mistake
from recon.skies import cells
from render import render_frame
from render.album import references_of
from render.compare import psnr
from render.rays import world_directions
from scenes import Scene, load
from scenes.poses import inverse, translation
from scenes.sky import sample_equirect, srgb_from_linear
from scenes.trajectory import Trajectory
from tests.bench.presets import random_splats

CONFIG = FitConfig(steps=160, budget=14_000, stages=((0.0, 2), (0.5, 1)), grow_every=6)
SIZE = (96, 54)


@pytest.fixture(scope="module")
def whole(drive, tmp_path_factory):
    out = tmp_path_factory.mktemp("fit") / "scene"
    return out, reconstruct(open_log(drive), out, size=SIZE, held_out=4, config=CONFIG)


def test_a_drive_becomes_a_scene_on_disk(whole):
    out, made = whole
    scene = load(out)
    assert isinstance(scene, Scene) and not checkpoint_path(out).exists()
    assert list(scene.rig) == ["front_camera"] and scene.meta["licence"] == "CC BY 4.0"
    assert len(scene.background.gaussians) > 300 and len(made.actors) == 1 and len(made.actors[0].asset.gaussians) > 50
    assert [p["track"] for p in scene.meta["parked"]] == ["veh_1"] or [p["track"] for p in scene.meta["parked"]] == ["veh_2"]


def test_photos_are_kept_that_were_not_held_out(whole):
    out, made = whole
    references = references_of(out, load(out))
    times = made.frame_times("front_camera").tolist()
    assert sorted(references.times.tolist()) == [t for i, t in enumerate(times) if i % 4]
    assert references.shots[0].read(*SIZE).shape == (SIZE[1], SIZE[0], 3)


def test_splats_drawn_by_lot_are_as_dense_as_all_are_in_the_mean():
    opacity = torch.linspace(0.05, 0.45, 50)
    splats = Splats.of([replace(random_splats(50, 1, sh_count=1), logit_opacities=torch.logit(opacity))], [torch.ones(50)])
    fit = SimpleNamespace(config=FitConfig(drop=0.5), progress=0.9, generator=torch.Generator().manual_seed(1))
    draws = torch.stack([torch.sigmoid(Fit._drawn_by_lot(fit, splats).fields["logits"]) for _ in range(4000)])
    assert ((draws < 1e-4).float().mean(0) - 0.5).abs().max() < 0.04
    assert (draws.mean(0) / opacity - 1).abs().max() < 0.08
    fit.progress = 0.0
    assert Fit._drawn_by_lot(fit, splats) is splats


def test_held_out_frames_are_reported_with_the_mean_image(whole):
    rows = whole[1].meta["held_out"]
    row = next(r for r in rows if r["which"] == "all")
    assert row["frames"] == [0, 4] and row["psnr"] > 27 and {"ssim", "mean_ssim"} <= row.keys()


def test_the_reported_views_are_the_scenes_own(whole, street):
    """The scene's camera at a recorded moment stands where the log's camera stood, within what the fit may correct."""
    scene = whole[1]
    for t in scene.frame_times("front_camera").tolist():
        off = inverse(scene.camera("front_camera", t).world_from_cam) @ street.camera("front_camera", t).world_from_cam
        assert off[:3, 3].norm() < 0.05


def test_the_mover_is_an_actor_and_not_in_the_background(whole, street):
    scene = whole[1]
    actor, truth = scene.actors[0], street.actors[0]
    for t in truth.trajectory.times_us[1:7].tolist():
        assert (actor.trajectory.at(t)[:3, 3] - truth.trajectory.at(t)[:3, 3]).norm() < 0.25
    pose = actor.trajectory.at(int(truth.trajectory.times_us[4]))
    local = (scene.background.gaussians.means.double() - pose[:3, 3]) @ pose[:3, :3]
    in_box = (local[:, :2].abs() < actor.asset.size[:2] / 2 - 0.2).all(1) & (local[:, 2] > 0.3) & (local[:, 2] < 1.3)
    assert in_box.sum() < 0.02 * len(local)


def test_an_interrupted_fit_goes_on_as_if_it_had_never_stopped(drive, tmp_path, whole, monkeypatch):
    log, out = open_log(drive), tmp_path / "scene"
    step = Fit.step
    stops = [95, 140]  # the later one when colours of what is hidden rest

    def interrupted(self):
        if stops and self.step_count == stops[0]:
            stops.pop(0)
            os.kill(os.getpid(), signal.SIGINT)
        return step(self)

    monkeypatch.setattr(Fit, "step", interrupted)
    for resume in (False, True):
        with pytest.raises(KeyboardInterrupt):
            reconstruct(log, out, size=SIZE, held_out=4, config=CONFIG, resume=resume)
        assert checkpoint_path(out).is_file() and not out.exists()
    with pytest.raises(FileExistsError, match="go on with it by --resume"):
        reconstruct(log, out, size=SIZE, held_out=4, config=CONFIG)
    monkeypatch.setattr(Fit, "step", step)
    with monkeypatch.context() as late, pytest.raises(KeyboardInterrupt):  # its photos make a scene whole
        late.setattr("recon.build.keep_album", lambda *_: os.kill(os.getpid(), signal.SIGINT) or time.sleep(9))
        reconstruct(log, out, size=SIZE, held_out=4, config=CONFIG, resume=True)
    assert checkpoint_path(out).is_file() and [p.name for p in tmp_path.iterdir()] == ["scene.fit"]
    monkeypatch.setattr("recon.ready.aligned", lambda *_: pytest.fail("sought how sweeps meet again"))
    resumed = reconstruct(log, out, size=SIZE, held_out=4, config=CONFIG, resume=True)
    for name, tensor in resumed.background.gaussians.tensors().items():
        assert torch.equal(tensor, getattr(whole[1].background.gaussians, name)), name
    assert resumed.meta["held_out"] == whole[1].meta["held_out"] and out.is_dir()


def test_movers_that_were_found_in_lidar_are_not_sought_again(drive, tmp_path, monkeypatch):
    config, log, out = replace(CONFIG, steps=24), open_log(drive), tmp_path / "scene"
    bare, sought, step = replace(log, tracks=()), [], Fit.step

    def found(log_, sweeps, report):
        sought.append(len(sweeps))
        return replace(log_, tracks=log.tracks)

    monkeypatch.setattr("recon.ready.with_movers", found)
    at_once = reconstruct(bare, tmp_path / "other", size=SIZE, held_out=4, config=config)
    with monkeypatch.context() as stopped, pytest.raises(KeyboardInterrupt):
        stopped.setattr(Fit, "step", lambda self: os.kill(os.getpid(), signal.SIGINT) if self.step_count == 12 else step(self))
        reconstruct(bare, out, size=SIZE, held_out=4, config=config)
    assert len(sought) == 2
    resumed = reconstruct(bare, out, size=SIZE, held_out=4, config=config, resume=True)
    assert len(sought) == 2
    assert [a.track for a in resumed.actors] == [a.track for a in at_once.actors] != []
    assert torch.equal(resumed.actors[0].trajectory.world_from_body, at_once.actors[0].trajectory.world_from_body)
    assert torch.equal(resumed.background.gaussians.means, at_once.background.gaussians.means)
    for table in ("held_out", "off_path"):
        assert resumed.meta[table] == at_once.meta[table]
    assert resumed.meta["movers"] == at_once.meta["movers"]


def test_mounts_that_were_found_are_not_sought_again(drive, tmp_path, monkeypatch):
    config, log, out, step = replace(CONFIG, steps=4), open_log(drive), tmp_path / "scene", Fit.step
    name, asked = next(iter(log.cameras)), []

    turned = {name: [0.0, 0.0, 0.0, 0.0, -0.1, 0.0, 0.01]}

    def raised(log, names, sweeps, span_us, report):
        asked.append((names, [s.index for s in sweeps]))
        return as_corrected(log, {REMOUNTED: {name: [0.5, 0.0]}})

    def looked_for(log, names, sweeps, span_us, report):
        asked.append((names, [s.index for s in sweeps]))
        return as_corrected(log, {TURNED: turned})

    monkeypatch.setattr("recon.ready.mounts_by_road", raised)
    monkeypatch.setattr("recon.ready.turned_by_surfaces", looked_for)
    with monkeypatch.context() as stopped, pytest.raises(KeyboardInterrupt):
        stopped.setattr(Fit, "step", lambda self: os.kill(os.getpid(), signal.SIGINT) if self.step_count == 2 else step(self))
        reconstruct(log, out, size=SIZE, held_out=4, config=config)
    resumed = reconstruct(log, out, size=SIZE, held_out=4, config=config, resume=True)
    assert asked == [([name], [s.index for s in log.sweeps if s.index not in (2, 6)])] * 2, "once each, and not by sweeps held out"
    assert resumed.meta[REMOUNTED] == {name: [0.5, 0.0]} and resumed.meta[TURNED] == turned
    off = resumed.rig[name].body_from_cam[:3, 3] - log.rig({name: SIZE})[name].body_from_cam[:3, 3]
    torch.testing.assert_close(off, torch.tensor([0, 0, 0.6], dtype=torch.float64), atol=0.01, rtol=0)
    plain = reconstruct(log, tmp_path / "other", size=SIZE, held_out=4, config=config.without("road", "surfaces"))
    assert REMOUNTED not in plain.meta and TURNED not in plain.meta and len(asked) == 2
    late = resumed.frame_times(name) - plain.frame_times(name)
    assert bool((late == 10_000).all()), "its pictures were taken so much later"


def test_a_scene_is_measured_by_sweeps_where_the_corrected_path_has_them(drive, tmp_path, monkeypatch):
    log, measured = open_log(drive), []

    def raised(log, sweeps, report):
        return moved(log, Trajectory(log.ego.times_us[:1], translation(0.0, 0.0, 0.5)[None]))

    monkeypatch.setattr("recon.ready.aligned", raised)
    monkeypatch.setattr("recon.build.off_path_table", lambda scene, log, sweeps, frames: measured.extend(sweeps) or [])
    reconstruct(log, tmp_path / "scene", size=SIZE, held_out=4, config=replace(CONFIG, steps=1))
    assert [s.index for s in measured] == [2, 6]
    recorded = {s.index: s.read().xyz for s in log.sweeps}
    for sweep in measured:
        np.testing.assert_allclose(sweep.read().xyz, recorded[sweep.index] + [0, 0, 0.5])


def test_a_size_that_is_too_small_is_refused_before_any_picture_is_read(drive, tmp_path, monkeypatch):
    monkeypatch.setattr(LogCamera, "image", lambda *_: pytest.fail("read a picture"))
    with pytest.raises(ValueError, match="pictures of 28x15 are too small to fit to; the smallest size is 16x16"):
        reconstruct(open_log(drive), tmp_path / "scene", size=(28, 15), config=CONFIG)
    monkeypatch.setattr("recon.open_log", lambda *_: pytest.fail("opened the log"))
    with pytest.raises(ValueError, match="28x15 are too small"):
        Recon(drive, tmp_path / "scene", size=(28, 15)).run()


def test_a_drive_with_more_lidar_than_memory_is_refused_with_the_fix(drive, tmp_path, monkeypatch):
    log, info = open_log(drive), tmp_path / "meminfo"
    monkeypatch.setattr("recon.memory.INFO", info)
    monkeypatch.setattr("recon.build.readied", lambda *_: pytest.fail("went on"))
    points = sum(len(s.read().xyz) for s in log.sweeps)
    info.write_text(f"MemTotal: 99999999 kB\nMemAvailable: {points * 200 // 4096} kB\n")
    with pytest.raises(ValueError, match=r"7 lidar sweeps of .* GiB are free; reconstruct a part with --duration 1s"):
        reconstruct(log, tmp_path / "scene", size=SIZE, held_out=0, config=CONFIG)
    for there in (True, False):
        monkeypatch.setattr("recon.memory.INFO", info if there else tmp_path / "nowhere")
        info.write_text(f"MemAvailable: {points * 200 // 512} kB\n")
        check_memory(log, log.sweeps)


def test_a_drive_whose_pictures_end_early_is_fitted_as_far_as_they_go(own_drive, tmp_path):
    """Its poses and boxes go on."""
    for i in (5, 6, 7):
        (own_drive / f"camera/front_camera/{i:02d}.jpg").unlink()
        (own_drive / f"lidar/{i:02d}.pkl.gz").unlink()
    config = FitConfig(steps=6, budget=3000, stages=((0.0, 2),), grow_every=3, sh_degree=0)
    log = open_log(own_drive)
    made = reconstruct(log, tmp_path / "scene", size=(48, 27), held_out=4, config=config)
    times = log.camera("front_camera").times_us
    assert len(times) == 5 and made.frame_times("front_camera").tolist() == times.tolist()
    assert [row["frames"] for row in made.meta["held_out"] if row["which"] == "all"] == [[0, 4]]
    assert made.ego.covers(int(times[-1])) and made.ego.times_us[-1] < log.ego.times_us[-1] and len(made.actors) == 1
    assert isinstance(load(tmp_path / "scene"), Scene)
    assert made.meta["fit"]["splats"] <= 3000 and len(made.actors[0].asset.gaussians) > 0, "a small budget is one, too"


def test_resuming_nothing_other_options_or_rubbish_is_refused(drive, tmp_path, monkeypatch):
    log, out = open_log(drive), tmp_path / "scene"
    log = replace(log, meta={**log.meta, "world_from_model": {"scale": 4.0}})
    with pytest.raises(FileNotFoundError, match="without --resume"):
        reconstruct(log, out, size=SIZE, config=CONFIG, resume=True)

    step = Fit.step

    def stop(self):
        os.kill(os.getpid(), signal.SIGINT)
        return step(self)

    monkeypatch.setattr(Fit, "step", stop)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(log, out, size=SIZE, config=CONFIG)
    with pytest.raises(ValueError, match="held_out 8, not 4"):
        reconstruct(log, out, size=SIZE, config=CONFIG, held_out=4, resume=True)
    with pytest.raises(ValueError, match=r"made with a --duration of 0.8s, not 0.5s; repeat its options"):
        reconstruct(log, out, size=SIZE, config=CONFIG, duration_us=500_000, resume=True)
    other = replace(log, meta={**log.meta, "world_from_model": {"scale": 8.0}})
    with pytest.raises(ValueError, match="made with 4 metres per unit of its model, not 8; repeat its options"):
        reconstruct(other, out, size=SIZE, config=CONFIG, resume=True)
    with pytest.raises(ValueError, match=f"made with folder '{drive}', not '{tmp_path}'"):
        reconstruct(replace(log, path=tmp_path), out, size=SIZE, config=CONFIG, resume=True)
    checkpoint_path(out).write_bytes(checkpoint_path(out).read_bytes()[:2000])
    with pytest.raises(ValueError, match="scene.fit"):
        reconstruct(log, out, size=SIZE, config=CONFIG, resume=True)


def test_who_is_stopped_by_sigterm_is_told_how_it_goes_on(drive, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("recon.reconstruct", lambda *_, **__: sys.exit(143))
    with pytest.raises(SystemExit) as stop:
        Recon(drive, tmp_path / "scene").run()
    assert stop.value.code == 143 and "stopped; nothing was fitted yet; give the command again" in capsys.readouterr().err


def test_an_existing_output_and_a_missing_folder_are_refused_before_any_work(drive, tmp_path):
    log = open_log(drive)
    with pytest.raises(FileExistsError):
        reconstruct(log, tmp_path)
    with pytest.raises(FileNotFoundError, match="create it first"):
        reconstruct(log, tmp_path / "a" / "b")
    with pytest.raises(ValueError, match="Did you mean front_camera"):
        reconstruct(log, tmp_path / "s", cameras=["frnt_camera"])


def test_a_span_keeps_the_frames_of_all_cameras_together(drive):
    log = open_log(drive)
    names = list(log.cameras)
    for start, duration, expected in ((0, None, 8), (0, 300_000, 3), (200_000, 300_000, 3), (500_000, None, 3)):
        first, last = _span(log, names, start, duration)
        for name in names:
            assert sum(first <= t <= last for t in log.cameras[name].times_us.tolist()) == expected
    with pytest.raises(ValueError, match="lasts 0.7s"):
        _span(log, names, 5_000_000, None)
    with pytest.raises(ValueError, match="must be positive"):
        _span(log, names, 0, -1)


def test_views_come_as_often_as_they_should_and_none_waits_for_long():
    count = 12
    turns = Turns(torch.where(torch.arange(count) < count // 2, 0.4, 1.0), torch.Generator().manual_seed(0))
    share, drawn = turns.shares, torch.tensor([turns.next() for _ in range(20 * count)])
    assert (torch.bincount(drawn, minlength=count) - share * len(drawn)).abs().max() <= 1.5
    for k in range(count):
        assert (drawn == k).nonzero()[:, 0].diff().max() * share[k] <= 2
    rounds = {tuple(drawn[at : at + count].tolist()) for at in range(0, len(drawn), count)}
    assert len(rounds) > 15, "in another order each time"


def test_nothing_is_left_standing_where_something_drove(drive, monkeypatch):
    log = open_log(drive)
    names, span = choose(log)
    start, fit = begin(log, names, span, SIZE, CONFIG, 4)
    track = start.tracks[0]
    middle = track.world_from_box[len(track.world_from_box) // 2, :3, 3].float() + torch.tensor([0, 0, 0.6 * float(track.size[2])])
    fit.splats.fields["means"][:20] = middle
    assert fit.population.swept.holds(fit.splats)[:20].all()
    split = split_points(log, log.sweeps_within(span), [t for t in log.tracks if t.moving])
    tracks = [*split.tracks, *(t for t in log.tracks if not t.moving)]
    taken = np.array([s.time_us for s in log.sweeps])[np.searchsorted([s.index for s in log.sweeps], split.static_sweep)]
    assert torch.equal(start.swept.keys, Swept.by(tracks, span, start.ground, split.static, taken).keys)
    fit.population.grow(fit.progress)
    assert not fit.population.swept.holds(fit.splats).any()
    fit.splats.fields["means"][:20] = middle
    count, tensors = len(fit.splats), fit.population.descent.tensors()
    squares, last = tensors["moments"][:, 1].uniform_().clone(), tensors["last"].random_(90).clone()
    stays = ~(fit.population.swept.holds(fit.splats) | fit.population.clear.holds(fit.splats))
    assert not stays[:20].any() and stays[20:].float().mean() > 0.9
    monkeypatch.setattr("recon.fit.population.halves", lambda *told: ([], []))  # which would change the cars
    for hanging in ("curtains", "pennants"):  # which beyond the pictures' borders there are
        monkeypatch.setattr(f"recon.fit.population.{hanging}", lambda splats, *told: torch.zeros(len(splats), dtype=torch.bool))
    fit.population.guess(fit._shown)
    tensors = fit.population.descent.tensors()
    assert torch.equal(tensors["moments"][:, 1], squares[stays]) and torch.equal(tensors["last"], last[stays])
    assert fit.population.guessed.shape == (int(stays.sum()),) and len(fit.splats) == stays.sum() < count, "nothing is split"
    assert not fit.population.swept.holds(fit.splats).any(), "what came later, too"


def test_a_start_measures_what_moves_too_and_is_what_a_checkpoint_keeps(drive, tmp_path):
    log = open_log(drive)
    names, span = choose(log)
    start, fit = begin(log, names, span, SIZE, CONFIG, 4)
    sweeps, movers = log.sweeps_within(span), [t for t in log.tracks if t.moving]
    split = split_points(log, sweeps, movers)
    still = by_lidar(log, fit.frames, sweeps, split, movers).views
    moving = by_lidar_of_movers(log, fit.frames, sweeps, split).views
    depths = start.measured[0].views
    assert sum(int(depth.isfinite().sum()) for depth in still.values()) > 100
    for which, depth in still.items():
        assert torch.equal(depths[which][depth.isfinite()], depth[depth.isfinite()])
    more = {which: depth.isfinite() & still[which].isnan() for which, depth in moving.items()}
    assert sum(int(m.sum()) for m in more.values()) > 30
    assert all(torch.equal(depths[which][m], moving[which][m]) for which, m in more.items())

    save_checkpoint(tmp_path / "scene.fit", {}, start, fit.tensors())
    kept = load_checkpoint(tmp_path / "scene.fit", {})[0]
    assert len(kept.swept.keys) and torch.equal(kept.swept.keys, start.swept.keys)
    assert all(torch.equal(m.nan_to_num(), kept.measured[0].views[w].nan_to_num()) for w, m in depths.items())


def test_a_fit_goes_on_under_the_sky_that_it_began_with(drive, tmp_path):
    """What points of pictures told of it is not sought again."""
    log = open_log(drive)
    names, span = choose(log, ["front_camera"])
    start, fit = begin(log, names, span, (48, 27), CONFIG, 4)
    told = tuple(torch.rand(sky.shape) < 0.5 for sky in start.skies)
    save_checkpoint(tmp_path / "scene.fit", {}, replace(start, skies=told), fit.tensors())
    kept = load_checkpoint(tmp_path / "scene.fit", {})[0]
    again = begin(log, names, span, (48, 27), CONFIG, 4, kept)[1]
    assert all(torch.equal(view.sky, sky) for view, sky in zip(again.frames.views, told, strict=True))


def test_what_the_sky_stands_in_for_comes_back(drive):
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    for _ in range(12):
        fit.step()
    view = fit.training[3]
    whole = fit._drawn(view, "rgb", "alpha")["alpha"].detach()
    above = (fit.splats.fields["means"][:, 2] > 1.0) & (fit.splats.group_of() == 0)
    fit.population.drop(above)
    count, end = len(fit.splats), fit.splats.sizes[0]
    rest = {k: t.clone() for k, t in (fit.splats.fields | fit.population.descent.tensors()).items()}
    torn = fit._drawn(view, "rgb", "alpha")["alpha"].detach()
    lost = (whole > 0.9) & (torn < 0.1)
    assert lost.sum() > 40
    fit._refill()
    new = len(fit.splats) - count
    assert new > 5 and fit.splats.sizes[0] == end + new and len(fit.population.growth.errors) == len(fit.splats)
    after = fit.splats.fields | fit.population.descent.tensors()
    assert all(torch.equal(torch.cat([t[:end], t[end + new :]]), rest[k]) for k, t in after.items())
    assert not fit.population.descent.moments[end : end + new].any()
    found = fit._drawn(view, "rgb", "alpha")["alpha"].detach()
    assert (found[lost] > 0.5).float().mean() > 0.6
    fit._refill()
    assert len(fit.splats) < count + 1.5 * new, "what is there does not come again"
    fit.step()


def test_at_night_a_sky_that_nothing_shows_does_not_shine(own_drive):
    """From aside it is seen beyond the pictures' borders."""
    for file in own_drive.glob("camera/*/*.jpg"):
        Image.fromarray((np.asarray(Image.open(file)) * 0.1).astype(np.uint8)).save(file, quality=95)
    log = open_log(own_drive)
    names, span = choose(log)
    start, fit = begin(log, names, span, SIZE, CONFIG, 4)
    assert max(float(v.image.float().mean()) for v in fit.training) / 255 < 0.1
    assert start.sky.max() < 0.15


def test_a_sky_as_bright_as_the_darkest_camera_tells_is_kept(drive):
    """The sun is white in every picture but in those of a camera that is exposed half as long."""
    log = open_log(drive)
    names, span = choose(log)
    start, fit = begin(log, names, span, SIZE, CONFIG, 4)
    with torch.no_grad():
        fit.sky.fill_(1.9)
        fit.exposures[:, :, :3] = torch.eye(3)
    assert float(srgb_from_linear(assemble(fit, start, log).sky.linear).max()) == pytest.approx(1, abs=1e-3)
    with torch.no_grad():
        fit.exposures[-1, :, :3] = 0.5 * torch.eye(3)
    scene = assemble(fit, start, log)
    camera = scene.camera(names[-1], span[0])
    upwards = translation(*camera.world_from_cam[:3, 3].tolist())
    assert float(render_frame(scene, replace(camera, world_from_cam=upwards)).rgb.median()) == pytest.approx(0.95, abs=0.01)


def test_splats_are_blamed_for_what_is_wrong_in_the_pixels_that_show_them(drive):
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    fit.step_count = BLAME_EVERY * 4
    view = fit.training[0]
    fit.turns.shares = torch.eye(len(fit.training))[0]  # the view that is drawn
    shot = fit.motion.shot(view, fit.targets.size(view, fit.shrink()))
    everything = fit.splats.select(torch.arange(len(fit.splats)), fit.sh_count())
    ones, sky = torch.ones(len(fit.splats), 1), partial(sample_equirect, fit.sky)
    with torch.no_grad():
        drawn = fit._render(everything, shot, sky, outputs=("rgb", "alpha", "features"), features=ones)
    alpha = drawn["alpha"]
    torch.testing.assert_close(drawn["features"][..., 0], alpha)  # a picture's weights of all splats are its alpha
    wrong = (drawn["rgb"] - fit.targets.picture(view, fit.shrink())).abs().mean(-1)
    fit.step()
    assert abs(float(fit.population.growth.errors.sum() / (wrong * alpha).sum()) / fit.shrink() ** 2 - 1) < 0.1, (
        "but for what the backdrop changes where alpha is low"
    )
    assert (fit.population.growth.errors >= 0).all()
    assert fit.population.growth.shown.max() == 1
    before = fit.population.growth.errors.clone()
    fit.step()
    assert torch.equal(fit.population.growth.errors, before), "only now and then"


@torch.no_grad()
def _mistakes(fit):
    found = []
    for view in fit.training:
        shot = fit.motion.shot(view, SIZE)
        shown = fit.splats.select(torch.arange(len(fit.splats)), fit.sh_count())
        drawn = fit._render(shown, shot, partial(sample_equirect, fit.sky), outputs=("rgb", "alpha", "depth"))
        found.append(float(mistake(drawn["depth"], drawn["alpha"], fit.measured[0].views[view.camera, view.index][None])))
    return np.mean(found)


def test_depth_follows_what_was_measured(drive):
    log = open_log(drive)
    names, span = choose(log)
    after = []
    for weight in (0.0, 1.0):
        _, fit = begin(log, names, span, SIZE, replace(CONFIG, steps=400, depth_weight=weight), 4)
        assert [len(m.views) for m in fit.measured[:2]] == 2 * [len(fit.training)]
        fit.measured = [Measured({k: 1.15 * depth for k, depth in fit.measured[0].views.items()}, 0.5)]
        before = _mistakes(fit)
        for _ in range(40):
            fit.step()
        after.append(_mistakes(fit) / before)
    assert after[0] > 0.9 and after[1] < 0.8 * after[0]


def test_from_aside_nothing_may_be_open_where_the_sky_is_never_seen(drive):
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    view = fit.training[0]
    camera = fit.openings.aside(view, fit.motion.camera(view), fit.generator)
    nothing = torch.zeros(camera.height, camera.width)
    below = float((world_directions(camera)[..., 2] < HORIZON).float().mean())
    open_ = float(fit.openings.gaps(nothing, camera)) / ASIDE_WEIGHT
    assert below + 0.1 < open_ < 0.9, "houses above the horizon count, and the sky does not"
    fit.openings.hidden[:] = False
    assert float(fit.openings.gaps(nothing, camera)) / ASIDE_WEIGHT == pytest.approx(below)
    assert float(fit.openings.gaps(1 - nothing, camera)) == 0


def test_of_opaque_splats_before_the_sky_each_is_asked_to_go(drive):
    """The one behind another, too, without which the picture would not be one bit clearer."""
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    view = fit.training[0]
    camera = fit.motion.camera(view)
    assert 0.05 < float(fit.openings.sky[view.camera, view.index].float().mean()) < 0.9
    pulls = []
    for other in (0.0, 0.9):
        opacity = torch.tensor(0.9, requires_grad=True)
        alpha = (1 - (1 - opacity) * (1 - other)).expand(camera.height, camera.width)
        fit.openings.haze(alpha, view, camera).backward()
        pulls.append(float(opacity.grad))
    assert pulls[1] > pulls[0] / 3 > 0, "alpha itself would pull a tenth as much"


def test_behind_what_always_hides_the_sky_is_no_light_to_rely_on(drive):
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    camera = fit.motion.camera(fit.training[0])
    directions = world_directions(camera)
    hidden = fit.openings.hidden[cells(directions, len(fit.openings.hidden))]
    assert 0.2 < float(hidden.float().mean()) < 0.95
    plain = sample_equirect(fit.sky, directions).detach()
    first, second = (fit.openings.backdrop(fit.sky, fit.generator)(directions) for _ in range(2))
    open_ = torch.nn.functional.max_pool2d((~hidden)[None, None].float(), 3, 1, 1)[0, 0] > 0
    assert (open_ & hidden).any()
    for shown in (first, second):
        torch.testing.assert_close(shown[open_], plain[open_])  # and beside what is open, or its grey would be seen there
        assert (shown[~open_] == shown[~open_][0, 0]).all()
    assert float((first - second).detach()[~open_].abs().min()) > 0.01
    first[~hidden].sum().backward()
    assert fit.sky.grad is not None and fit.sky.grad.any()
    fit.sky.grad = None
    second[~open_].sum().backward()
    assert not fit.sky.grad.any()


def test_a_drive_without_lidar_whose_pictures_show_no_features_is_refused(own_drive, tmp_path):
    pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")
    for file in (own_drive / "lidar").glob("*.pkl.gz"):
        file.unlink()
    for file in (own_drive / "camera").glob("*/*.jpg"):
        Image.new("RGB", (96, 54), (90, 90, 90)).save(file)
    with pytest.raises(ValueError, match="no training picture shows what another one shows"):
        reconstruct(open_log(own_drive), tmp_path / "s", size=SIZE, config=replace(CONFIG, steps=1))


def test_small_poses_are_the_exponential_map():
    delta = torch.tensor([[0.0, 0.0, 0.3, 1.0, 2.0, 3.0], [0.0] * 6])
    poses = small_poses(delta)
    torch.testing.assert_close(poses[1], torch.eye(4, dtype=torch.float64))
    assert float(torch.atan2(poses[0, 1, 0], poses[0, 0, 0])) == pytest.approx(0.3, abs=1e-6)
    torch.testing.assert_close(small_poses(-delta[0]) @ poses[0], torch.eye(4, dtype=torch.float64), atol=1e-12, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.02, 1.0, math.pi - 1e-9, math.pi, 6.2])
def test_small_poses_and_their_gradients_are_those_of_the_matrix_exponential(angle):
    generator = torch.Generator().manual_seed(2)
    deltas, weights = (torch.randn(20, *shape, dtype=torch.float64, generator=generator) for shape in ((6,), (4, 4)))
    deltas[:, :3] *= angle / deltas[:, :3].norm(dim=1, keepdim=True)
    deltas.requires_grad_()
    found = small_poses(deltas)
    x, y, z, *moved = deltas.unbind(1)
    o = torch.zeros_like(x)
    rows = ([o, -z, y, moved[0]], [z, o, -x, moved[1]], [-y, x, o, moved[2]], [o] * 4)
    exact = torch.linalg.matrix_exp(torch.stack([torch.stack(row, 1) for row in rows], 1))
    torch.testing.assert_close(found, exact, atol=1e-13, rtol=0)
    slopes = [torch.autograd.grad((poses * weights).sum(), deltas, retain_graph=True)[0] for poses in (found, exact)]
    torch.testing.assert_close(*slopes, atol=1e-12, rtol=0)


def test_corrections_between_knots_are_between_theirs():
    knots = Knots(Trajectory(torch.tensor([0, 100, 300]), torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)))
    knots.deltas = torch.arange(3.0)[:, None].expand(3, 6).clone()
    import numpy as np

    _, knot, share = knots.base(np.array([0, 50, 200, 300]))
    torch.testing.assert_close(knots.correction(knot, share)[:, 0], torch.tensor([0.0, 0.5, 1.5, 2.0]))
    held_out = Knots(knots.trajectory, torch.tensor([0, 300]))
    held_out.deltas = torch.tensor([[0.0], [3.0]]).expand(2, 6).clone()
    shift = held_out.corrected(0.0, 0.1).world_from_body[:, 0, 3]
    torch.testing.assert_close(shift, torch.tensor([0.0, 0.1, 0.3], dtype=torch.float64))


def test_a_fit_stopped_early_gives_scenes_that_get_better(drive, tmp_path, monkeypatch):
    log = open_log(drive)
    short = replace(CONFIG, steps=80)
    paths = stopped_early(log, tmp_path / "early", shares=(0.5, 0.1, 1.0), size=SIZE, config=short)
    assert [p.name for p in paths] == ["10", "50", "100"]
    scenes = [load(p) for p in paths]
    assert len({len(s.background.gaussians) for s in scenes}) > 1 and scenes[0].meta["name"].endswith("at 10 percent")
    view, photo = log.cameras["front_camera"], []
    for scene in scenes:
        camera = scene.camera("front_camera", int(view.times_us[4])).resized(*SIZE)
        photo.append(psnr(render_frame(scene, camera).rgb, torch.from_numpy(np.array(view.image(4, *SIZE))) / 255))
    assert photo[0] < photo[2]
    monkeypatch.setattr(Fit, "step", None)  # nothing is fitted again
    assert stopped_early(log, tmp_path / "early", shares=(0.1, 0.5, 1.0), size=SIZE, config=short) == paths
    with pytest.raises(ValueError, match="shares"):
        stopped_early(log, tmp_path / "early", shares=(0.0,))


@pytest.mark.parametrize("damaged", [b"", b"\x80\x02.", b"\x80\x02X\x02\x00\x00\x00\xff\xff.", bytes(100)])
def test_a_damaged_checkpoint_is_refused_with_the_fix(tmp_path, damaged):
    """Bytes at which torch's unpickler finds its stack empty, or text that is none, too."""
    path = tmp_path / "s1.fit"
    path.write_bytes(damaged)
    with pytest.raises(
        ValueError, match=r"s1\.fit is not a fit that can go on \(it is damaged, or something else\); delete it and run without --resume"
    ):
        load_checkpoint(path, {})
