"""Reconstructions from less than was recorded, of the made-up street."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_drive import write_drive

from enhance.pairs.refits import SHORT, Less, as_reconstructed, by_turns, exposed_as, refits, rendered_aside, thinned
from recon import open_log
from recon.fit.fit import Fit
from recon.registration.corrected import MOVED
from render import render_frame
from render.compare import psnr
from scenes.poses import inverse

SIZE = (96, 54)
QUICK = Less(fit=replace(SHORT, steps=25, budget=4000))


@pytest.fixture(scope="module")
def log(street, tmp_path_factory):
    return open_log(write_drive(tmp_path_factory.mktemp("drive") / "002", street))


def test_every_fifth_frame_is_kept_with_its_moment(log):
    camera = log.camera("front_camera")
    few = thinned(camera, 5)
    assert len(few) == 2 and few.times_us.tolist() == camera.times_us[::5].tolist() and few.files == camera.files[::5]
    fast, slow = (replace(camera, times_us=camera.times_us[0] + step * torch.arange(len(camera))) for step in (33_333, 500_000))
    assert thinned(fast, 2).files == camera.files[::6], "as far apart on the way"
    assert thinned(slow, 2).files == camera.files[::2]


def test_neighbouring_cameras_fall_into_different_halves(log):
    first, second = by_turns(log)
    assert {*first, *second} == set(log.cameras) and len(first) == len(second) == 1


def test_a_recording_gets_the_scenes_poses(log, street):
    corrected = as_reconstructed(log, street)
    for name, camera in corrected.cameras.items():
        for pose, t in zip(camera.world_from_cam, camera.times_us.tolist(), strict=True):
            assert torch.allclose(pose, street.camera(name, t).world_from_cam)


def test_a_recording_is_moved_as_its_scene_was(log, street):
    up = torch.eye(4, dtype=torch.float64)
    up[2, 3] = 0.5
    meta = {**street.meta, MOVED: {"times_us": [0], "poses": [up.flatten().tolist()]}}
    moved = as_reconstructed(log, replace(street, meta=meta))
    for before, after in zip(log.sweeps, moved.sweeps, strict=True):
        np.testing.assert_allclose(after.read().xyz - before.read().xyz, np.tile([0, 0, 0.5], (len(before.read().xyz), 1)), atol=1e-9)
    assert torch.equal(moved.ego.world_from_body, street.ego.world_from_body), "of cameras and body the scene itself knows better"


def test_a_refit_gives_frames_exposures_of_their_own_where_its_scene_does(street):
    rig = {name: replace(c, gains=torch.ones(len(c.times_us), 3)) for name, c in street.rig.items()}
    assert "gains" in SHORT.refine and "gains" not in exposed_as(street, SHORT).refine
    assert "gains" in exposed_as(replace(street, rig=rig), SHORT).refine


def test_the_cycles_pictures_are_taken_from_beside_the_path(log, street, tmp_path):
    rolling = {name: replace(camera, shutter="rows", readout_us=30_000) for name, camera in log.cameras.items()}
    aside = rendered_aside(street, as_reconstructed(replace(log, cameras=rolling), street), tmp_path, 1.5, SIZE)
    for name, camera in aside.cameras.items():
        assert (camera.shutter, camera.readout_us) == ("global", 0)  # as renders are
        there = street.camera(name, int(camera.times_us[2]))
        body = street.ego.at(int(camera.times_us[2]))
        moved = inverse(body)[:3, :3] @ (camera.world_from_cam[2] - there.world_from_cam)[:3, 3]
        assert torch.allclose(moved, torch.tensor([0.0, 1.5, 0.0], dtype=torch.float64), atol=1e-6)
        assert camera.image(2).shape == (SIZE[1], SIZE[0], 3)


def test_a_refit_lies_where_the_scene_lies_and_is_kept(log, street, tmp_path, monkeypatch):
    (made,) = refits("sparse", street, log, tmp_path, QUICK, SIZE)
    assert made.cameras == tuple(street.rig)
    camera = street.camera("front_camera", int(street.frame_times("front_camera")[2])).resized(*SIZE)
    assert psnr(render_frame(made.references.recorded, camera).rgb, render_frame(street, camera).rgb) > 15
    moved = inverse(made.references.recorded.ego.at(camera.time_us)) @ street.ego.at(camera.time_us)
    assert torch.allclose(moved, torch.eye(4, dtype=torch.float64), atol=0.02)  # poses were not corrected again
    monkeypatch.setattr(Fit, "step", None)
    assert len(refits("sparse", street, log, tmp_path, QUICK, SIZE)) == 1


def test_a_refit_is_exposed_as_its_scene_is(log, street, tmp_path):
    """Half a rig by itself would take its own first camera for the measure, and the other half's views would be too bright or too dark."""
    darker = torch.cat([torch.diag(torch.tensor([0.7, 0.8, 0.9])), torch.full((3, 1), 0.01)], 1)
    dark = replace(street, rig=street.rig | {"left_camera": replace(street.rig["left_camera"], exposure=darker)})
    halves = refits("crossref", dark, log, tmp_path, QUICK, SIZE)
    kept = {name: camera.exposure for r in halves for name, camera in r.references.recorded.rig.items()}
    assert set(kept) == {"front_camera", "left_camera"}
    assert all(torch.equal(kept[name], camera.exposure) for name, camera in dark.rig.items())
    for refit in halves:
        for name, camera in log.cameras.items():
            if name in refit.references.recorded.rig:
                shown = render_frame(refit.references.recorded, refit.references.recorded.camera(name, int(camera.times_us[3]))).rgb
                photo = torch.from_numpy(camera.image(3, *SIZE).copy()).float() / 255
                assert float(shown.mean() / photo.mean()) == pytest.approx(1, abs=0.1)


def test_each_half_of_the_rig_shows_the_other_halfs_views(log, street, tmp_path, monkeypatch):
    monkeypatch.setattr("enhance.pairs.refits._fit", lambda scene, part, path, config, size, device: _instead(scene, path))
    made = refits("crossref", street, log, tmp_path, QUICK, SIZE)
    assert {r.cameras for r in made} == {("front_camera",), ("left_camera",)}
    alone = replace(street, rig={"front_camera": street.rig["front_camera"]})
    with pytest.raises(ValueError, match="two cameras"):
        refits("crossref", alone, log, tmp_path / "alone", QUICK, SIZE)


def _instead(street, path):
    from scenes.files import save

    save(street, path)


def test_seeds_leave_out_other_things():
    assert Less.drawn(0) == Less() and Less.drawn(3) == Less.drawn(3)
    drawn = [Less.drawn(seed) for seed in range(1, 9)]
    assert len({less.every for less in drawn}) > 2 and {less.aside > 0 for less in drawn} == {True, False}
    assert len({less.fit.budget for less in drawn}) == len({less.fit.steps for less in drawn}) == len(drawn)
    assert all(0.7 <= abs(less.aside) <= 3 and 900 < less.fit.steps < 3500 and 40_000 <= less.fit.budget < 200_000 for less in drawn)
