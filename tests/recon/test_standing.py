"""What stands is as far as lidar ever measured it, and goes on upwards."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from painted import SIZE, drive, sweep_of
from painted import wall as wall_points

from recon.objects.actors import split_points
from recon.seeds.measured import grid_of
from recon.seeds.standing import BESIDE, CLOSE, FURTHER, RISES, by_all_sweeps, upwards
from recon.views.frames import load_frames
from scenes.lenses import Fisheye, OpenCV, Pinhole

RISE = np.repeat(np.linspace(0.4, -0.2, 60)[:, None], 30, 1)  # 0.01 a row, the uppermost first


def depth_with(**columns: tuple[int, float]) -> np.ndarray:
    """NaN but for a metre value from a row on downwards, a column each, as c7=(30, 12.0)."""
    depth = np.full(RISE.shape, np.nan)
    for column, (row, metres) in columns.items():
        depth[row:, int(column[1:])] = metres
    return depth


def wall(row: int, metres: float) -> np.ndarray:
    return depth_with(**{f"c{c}": (row, metres) for c in range(30)})


def test_a_wall_goes_on_above_the_highest_beam_for_a_while():
    nothing = np.zeros(RISE.shape, bool)
    found = upwards(wall(30, 12.0), RISE, nothing)
    known = np.isfinite(found[:, 15])
    assert (found[known] == 12).all() and known[30:].all()
    assert abs(known.sum() - 30 - FURTHER / 0.01) < 2, "not for ever"
    assert not np.isfinite(upwards(wall(30, CLOSE + 1), RISE, nothing)[:30]).any(), "behind what is far stand towers"
    below = upwards(wall(50, 12.0), RISE, nothing)  # its highest point is a little below the horizon
    assert not np.isfinite(below[:50][RISE[:50] < RISES]).any()


def test_it_ends_at_the_sky_and_does_not_begin_again_behind_it():
    sky = np.zeros(RISE.shape, bool)
    sky[24:26] = True
    found = upwards(wall(30, 12.0), RISE, sky)
    assert np.isfinite(found[26:]).all() and not np.isfinite(found[:26]).any()


def test_one_beam_among_others_that_met_a_wire_does_not_decide():
    nothing, depth = np.zeros(RISE.shape, bool), wall(30, 12.0)
    depth[30, 15] = 4.0
    found = upwards(depth, RISE, nothing)
    assert found[30, 15] == 4.0, "what is measured stays"
    assert (found[20:30] == 12.0).all()
    lone = upwards(depth_with(c15=(30, 12.0)), RISE, nothing)
    assert np.isfinite(lone[29]).sum() == 2 * BESIDE + 1 and not np.isfinite(lone[29, : 15 - BESIDE]).any()


@pytest.mark.parametrize("lens", [Pinhole(100, 100, 160, 90), Fisheye(100, 100, 160, 90)])
@pytest.mark.parametrize("pitch", [0.0, 0.3])
def test_upright_means_as_far_over_the_ground_for_every_lens_and_camera(lens, pitch):
    log = drive([0.0, 0.5, 0.5], ("front",))
    front = log.cameras["front"]
    up = torch.tensor([[1, 0, 0, 0], [0, math.cos(pitch), math.sin(pitch), 0], [0, -math.sin(pitch), math.cos(pitch), 0], [0, 0, 0, 1]])
    log = replace(log, cameras={"front": replace(front, lens=lens, world_from_cam=front.world_from_cam @ up.double())})
    frames = load_frames(log, ["front"], (0, 10**18), SIZE, 0)
    frames = replace(frames, views=[replace(v, sky=torch.zeros_like(v.sky)) for v in frames.views])
    sweeps = [sweep_of(240_000, wall_points(12.0, -8, 8))]
    depth = by_all_sweeps(log, frames, split_points(log, sweeps, []), []).views[0, 0].double().numpy()
    camera = grid_of(log.camera("front").camera(0, *SIZE))
    local = camera.lens.unproject(camera.pixel_centres())
    at = (local / camera.lens.depth(local)[..., None] @ camera.world_from_cam[:3, :3].T).numpy() * depth[..., None]
    known = np.isfinite(depth)
    heights, middle = at[known][:, 2] + float(camera.world_from_cam[2, 3]), np.abs(at[known][:, 1]) < 1
    assert (heights > 3.0).any(), "it goes on above the wall's points"
    np.testing.assert_allclose(at[known][middle, 0], 12.0 - float(camera.world_from_cam[0, 3]), rtol=0.02)


def test_other_sweeps_tell_how_far_a_wall_is_above_the_horizon():
    log = drive([0.0, 0.5, 0.5], ("front",))
    frames = load_frames(log, ["front"], (0, 10**18), SIZE, 0)
    sweeps = [sweep_of(240_000, wall_points(12.0, -3, 3))]  # at no picture's moment
    measured = by_all_sweeps(log, frames, split_points(log, sweeps, []), [])
    assert set(measured.views) == {(0, v.index) for v in frames.training()}
    depth = measured.views[0, 0].float()
    camera = log.camera("front").camera(0, *SIZE)
    known = depth.isfinite()
    assert known.any() and (depth[known] - (12 - float(camera.world_from_cam[0, 3]))).abs().max() < 0.05
    rows = known.any(1).nonzero()[:, 0]
    assert rows.max() < depth.shape[0] / 2 + 1, "below the horizon the sweep of the moment decides"
    assert torch.equal(measured.views[0, 1].isfinite(), measured.views[0, 1] > 0)


def test_a_lens_is_undone_once_for_all_its_pictures(monkeypatch):
    """Waymo's takes a second of iterations: picture by picture they took minutes of a short drive."""
    log, asked = drive([0.0, 0.5, 0.5], ("front",)), []
    camera = log.camera("front")
    bent = replace(camera, lens=OpenCV(*camera.lens.params().tolist(), -0.031, 0.01))
    log = replace(log, cameras={"front": bent})
    frames = load_frames(log, ["front"], (0, 10**18), SIZE, 0)
    sweeps = [sweep_of(240_000, wall_points(12.0, -3, 3))]
    undone = OpenCV.unproject
    monkeypatch.setattr(OpenCV, "unproject", lambda lens, pixels: asked.append(len(pixels)) or undone(lens, pixels))
    by_all_sweeps(log, frames, split_points(log, sweeps, []), [])
    assert len(asked) == 1
