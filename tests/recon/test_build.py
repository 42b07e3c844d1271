"""A drive becomes a scene on disk: what is written and reported, interrupted and gone on with, refused."""

import os
import signal
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from quick_fit import CONFIG, SIZE

from recon import open_log, reconstruct
from recon.checkpoint import checkpoint_path, load_checkpoint
from recon.commands import Recon
from recon.fit.config import FitConfig
from recon.fit.fit import Fit
from recon.log import LogCamera
from recon.memory import check_memory
from recon.registration.corrected import REMOUNTED, TURNED, as_corrected, moved
from render.album import references_of
from scenes import Scene, load
from scenes.poses import inverse, translation
from scenes.trajectory import Trajectory


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
    assert sorted(references.times.tolist()) == [t for i, t in enumerate(times) if i != 4]
    assert references.shots[0].read(*SIZE).shape == (SIZE[1], SIZE[0], 3)


def test_held_out_frames_are_reported_with_the_mean_image(whole):
    rows = whole[1].meta["held_out"]
    row = next(r for r in rows if r["which"] == "all")
    assert row["frames"] == [4] and row["psnr"] > 27 and {"ssim", "mean_ssim"} <= row.keys()


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
    monkeypatch.setattr("recon.ready.mounts_by_surfaces", looked_for)
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
    monkeypatch.setattr("recon.build.off_path_table", lambda scene, log, sweeps, frames, shifts: measured.extend(sweeps) or [])
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
    assert [row["frames"] for row in made.meta["held_out"] if row["which"] == "all"] == [[2]]
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
    with pytest.raises(ValueError, match=r"made with an --effort of 160 steps and 14,000 splats, not 1,664 and 175,600; repeat"):
        reconstruct(log, out, size=SIZE, config=replace(CONFIG, steps=1664, budget=175_600), resume=True)
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
    assert stop.value.code == 143 and "stopped; nothing was kept yet; give the command again" in capsys.readouterr().err


def test_an_existing_output_and_a_missing_folder_are_refused_before_any_work(drive, tmp_path):
    log = open_log(drive)
    with pytest.raises(FileExistsError):
        reconstruct(log, tmp_path)
    with pytest.raises(FileNotFoundError, match="create it first"):
        reconstruct(log, tmp_path / "a" / "b")
    with pytest.raises(ValueError, match="Did you mean front_camera"):
        reconstruct(log, tmp_path / "s", cameras=["frnt_camera"])


def test_a_drive_without_lidar_whose_pictures_show_no_features_is_refused(own_drive, tmp_path):
    pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")
    for file in (own_drive / "lidar").glob("*.pkl.gz"):
        file.unlink()
    for file in (own_drive / "camera").glob("*/*.jpg"):
        Image.new("RGB", (96, 54), (90, 90, 90)).save(file)
    with pytest.raises(ValueError, match="no training picture shows what another one shows"):
        reconstruct(open_log(own_drive), tmp_path / "s", size=SIZE, config=replace(CONFIG, steps=1))


@pytest.mark.parametrize("damaged", [b"", b"\x80\x02.", b"\x80\x02X\x02\x00\x00\x00\xff\xff.", bytes(100)])
def test_a_damaged_checkpoint_is_refused_with_the_fix(tmp_path, damaged):
    """Bytes at which torch's unpickler finds its stack empty, or text that is none, too."""
    path = tmp_path / "s1.fit"
    path.write_bytes(damaged)
    with pytest.raises(
        ValueError, match=r"s1\.fit is not a fit that can go on \(it is damaged, or something else\); delete it and run without --resume"
    ):
        load_checkpoint(path, {})
