from dataclasses import replace

import numpy as np
import pytest
import torch

from recon import open_log
from recon.defaults import choose
from recon.evaluation.offpath import depth_errors, flicker_along, held_out_sweeps, off_path_table, off_path_text, shifts_within
from recon.evaluation.road import photo_at, road_errors, road_points
from recon.views.frames import load_frames
from scenes import Gaussians
from tests.street import splats


def without(scene, which):
    g = scene.background.gaussians
    return replace(scene, background=replace(scene.background, gaussians=Gaussians(*(t[~which] for t in g.tensors().values()))))


@pytest.fixture(scope="module")
def log(drive):
    return open_log(drive)


def test_sweeps_are_held_out_between_the_held_out_pictures(log):
    assert [s.index for s in held_out_sweeps(log, 4)] == [2, 6]
    assert held_out_sweeps(log, 0) == ()


def test_the_street_itself_is_near_its_lidar_on_and_off_the_path(street, log):
    rows = off_path_table(street, log, held_out_sweeps(log, 4), shifts=(0.0, 2.0))
    assert [r["shift_m"] for r in rows] == [0.0, 2.0]
    for row in rows:
        assert row["depth_error"] < 0.1 and row["points"] > 200 and row["holes"] < 0.02
    assert "2 m aside" in off_path_text(rows)


def test_what_moves_is_measured_where_it_is(street, log):
    sweeps = held_out_sweeps(log, 4)
    right = off_path_table(street, log, sweeps, shifts=(0.0, 2.0))
    (actor,) = street.actors
    nearer = replace(actor, trajectory=actor.trajectory.shifted(forward=-4.0))
    wrong = off_path_table(replace(street, actors=(nearer,)), log, sweeps, shifts=(0.0, 2.0))
    assert all(row["movers_error"] < 0.1 for row in right) and all(row["movers_error"] > 0.18 for row in wrong)
    assert wrong[0]["depth_error"] == pytest.approx(right[0]["depth_error"], abs=0.01), "what stands still is another matter"
    bare = off_path_table(street, replace(log, tracks=()), sweeps, shifts=(0.0,))
    assert bare[0]["movers_error"] is None and "-" in off_path_text(bare)


def test_a_torn_road_shows_as_holes_and_a_wrong_one_as_depth_error(street, log):
    sweeps = held_out_sweeps(log, 4)
    means = street.background.gaussians.means
    torn = without(street, (means[:, 2] < 0.1) & (means[:, 0] % 6 < 3))
    right, holed = (off_path_table(s, log, sweeps, shifts=(0.0,))[0] for s in (street, torn))
    assert holed["holes"] > right["holes"] + 0.1
    pose = street.background.world_from_local.clone()
    pose[1, 3] = 4.0
    aside = replace(street, background=replace(street.background, world_from_local=pose))
    assert off_path_table(aside, log, sweeps, shifts=(0.0,))[0]["depth_error"] > 2 * right["depth_error"]


def board(x, width, height, hole=0.0):
    """An upright board across the road `x` metres ahead, without a strip `hole` wide in its middle."""
    y, z = torch.meshgrid(torch.arange(-width / 2, width / 2, 0.25), torch.arange(0.1, height, 0.25), indexing="ij")
    points = torch.stack([torch.full_like(y, x), y, z], -1).reshape(-1, 3)
    return splats(points[points[:, 1].abs() >= hole / 2], (0.5, 0.4, 0.3), (0.02, 0.2, 0.2))


def test_a_gap_before_the_sky_that_opens_only_beside_the_path_shows_as_a_hole_above(street, log):
    """A wall ahead with a slit in it that a board hides from the path."""
    rows = []
    for hole in (6.0, 0.0):
        ahead = Gaussians.cat([board(40, 110, 40, hole), board(16, 3.0, 16)])
        scene = replace(
            street, background=replace(street.background, gaussians=ahead), actors=(), rig={"front_camera": street.rig["front_camera"]}
        )
        rows.append([r["holes_above"] for r in off_path_table(scene, log, held_out_sweeps(log, 4), shifts=(0.0, 2.0))])
    (on_it, beside), closed = rows
    assert on_it == 0 and beside > 0.005 and closed == [0, 0]


def test_a_wall_over_a_third_of_the_picture_stands_in_the_way_of_lidar_though_the_median_is_right(street, log):
    wall = splats(board(9.0, 5.0, 5.0).means + torch.tensor([0.0, -4.0, 0.0]), (0.1, 0.1, 0.1), (0.02, 0.2, 0.2))
    walled = replace(street, background=replace(street.background, gaussians=Gaussians.cat([street.background.gaussians, wall])))
    right, wrong = (off_path_table(s, log, held_out_sweeps(log, 4), shifts=(0.0,))[0] for s in (street, walled))
    assert right["in_the_way"] < 0.02 and wrong["in_the_way"] > 0.1
    assert wrong["depth_error"] < 2 * right["depth_error"] and "in the way" in off_path_text([wrong])


def test_points_behind_nearer_points_do_not_count(street):
    camera = street.camera("front_camera", int(street.frame_times("front_camera")[0]))
    pose = camera.world_from_cam
    near, far = ((pose @ torch.tensor([0.01, 0.01, z, 1.0], dtype=torch.float64))[:3].numpy() for z in (5.0, 50.0))
    depth = np.full((camera.height, camera.width), 5.0)
    assert np.allclose(depth_errors(depth, np.stack([near, far]), camera), [0.0, np.nan], atol=1e-6, equal_nan=True)
    assert np.allclose(depth_errors(depth, far[None], camera), [-0.9])
    assert np.allclose(depth_errors(np.full_like(depth, np.inf), near[None], camera), [1.0])


def test_a_street_that_does_not_change_hardly_flickers(street):
    means = street.background.gaussians.means
    calm = flicker_along(street, 1.0)
    shades = street.background.gaussians.sh.clone()
    shades[means[:, 2] < 0.1] += 2 * torch.rand(int((means[:, 2] < 0.1).sum()), 1, 3, generator=torch.Generator().manual_seed(0)) - 1
    noisy = replace(street, background=replace(street.background, gaussians=replace(street.background.gaussians, sh=shades)))
    assert 0 < calm < flicker_along(noisy, 1.0)


@pytest.fixture(scope="module")
def frames(log):
    return load_frames(log, ["front_camera", "left_camera"], choose(log)[1], (96, 54), 4)


def test_what_covers_the_road_only_beside_the_path_shows_in_its_colours(street, log, frames):
    """A wall along the path, seen edge on from it."""
    sweeps, street = held_out_sweeps(log, 4), replace(street, rig={"front_camera": street.rig["front_camera"]})
    right = [r["road"] for r in off_path_table(street, log, sweeps, frames, (0.0, 2.0))]
    edge = splats(board(0.0, 50.0, 0.9).means[:, [1, 0, 2]] + torch.tensor([20.0, 0.0, 0.0]), (0.9, 0.1, 0.1), (0.2, 0.005, 0.2))
    walled = replace(street, background=replace(street.background, gaussians=Gaussians.cat([street.background.gaussians, edge])))
    wrong = [r["road"] for r in off_path_table(walled, log, sweeps, frames, (0.0, 2.0))]
    assert min(right) > 25
    assert wrong[0] > wrong[1] + 2 and wrong[1] < right[1] - 10


def test_the_recording_car_and_what_lies_off_the_road_are_no_road(street, log, frames):
    name, time = "front_camera", log.sweeps[2].time_us
    view, camera = photo_at(frames, name, time), street.camera(name, time)
    points = road_points(log.sweeps[2].read().xyz, street.ground)
    assert len(points) > 100 and np.abs(points[:, 2] - street.ground.height(torch.from_numpy(points[:, :2])).numpy()).max() < 0.05
    picture = view.image.float() / 255
    right = road_errors(picture, camera, view, camera, points)
    assert len(right) > 20 and right.max() == 0
    assert road_errors(1 - picture, camera, view, camera, points).mean() > 0.01
    assert not len(road_errors(picture, camera, replace(view, ego=torch.ones(54, 96, dtype=torch.bool)), camera, points))
    assert not len(road_points(points + [0, 0, 1.0], street.ground))


def test_shifts_are_a_streets_or_end_where_a_room_does():
    assert shifts_within(3.0) == shifts_within(9.0) == [0.0, 1.0, 2.0, 3.0] and shifts_within(1.2) == [0.0, 0.4, 0.8, 1.2]
