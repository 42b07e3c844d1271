from dataclasses import replace
from pathlib import Path

import numpy as np
import painted
import pytest
import torch
from randomized import gaussians
from scipy.spatial import cKDTree

from recon import open_log
from recon.body_path import body_path
from recon.log import Log, LogCamera, Track
from recon.objects.actors import split_points
from recon.seeds.actors import actor_seeds, even_limit
from recon.seeds.carpet import carpet
from recon.seeds.points import Cloud, colours, fewer, first_exposures, merged_colours, nearest_box, splats_from, thin
from recon.views.frames import Frames, load_frames
from recon.views.view import View
from scenes.camera import RigCamera
from scenes.ground import Ground
from scenes.harmonics import rgb_from_sh
from scenes.lenses import Pinhole
from scenes.poses import matrix_from_quat, translation, yaw
from scenes.spread import spread
from scenes.trajectory import Trajectory

ALL = (0, 2**62)


def test_points_take_the_colour_of_the_pixel_they_fall_on(drive):
    log = open_log(drive)
    frames = load_frames(log, ["front_camera"], ALL, (96, 54), 8)
    view = frames.training()[0]
    camera = log.camera("front_camera").camera(view.index)
    ray = camera.lens.unproject(torch.tensor([40.5, 30.5], dtype=torch.float64)) * 7
    point = (camera.world_from_cam[:3, :3] @ ray + camera.world_from_cam[:3, 3]).numpy()[None]
    seen = colours(log, frames, np.concatenate([point, -100 * point]), np.full(2, view.time_us), [])
    np.testing.assert_allclose(seen[0, 0], view.image[30, 40].numpy() / 255, atol=1e-6)
    assert np.isnan(seen[0, 1]).all()


def test_points_take_it_from_the_picture_of_their_time_whatever_its_number(drive):
    """A camera that lacks half of its frames has other numbers than the sweeps."""
    log = open_log(drive)
    camera = log.camera("front_camera")
    few = replace(camera, files=camera.files[::2], times_us=camera.times_us[::2], world_from_cam=camera.world_from_cam[::2])
    frames = load_frames(replace(log, cameras={"front_camera": few}), ["front_camera"], ALL, (96, 54), 0)
    view = frames.training()[-1]
    eye = few.camera(view.index)
    ray = eye.lens.unproject(torch.tensor([40.5, 30.5], dtype=torch.float64)) * 7
    point = (eye.world_from_cam[:3, :3] @ ray + eye.world_from_cam[:3, 3]).numpy()[None]
    taken = min(log.sweeps, key=lambda s: abs(s.time_us - view.time_us)).time_us
    seen = colours(replace(log, cameras={"front_camera": few}), frames, point, np.array([taken]), [])
    np.testing.assert_allclose(seen[0, 0], view.image[30, 40].numpy() / 255, atol=1e-6)


def test_points_behind_a_mover_are_not_seen(drive):
    log = open_log(drive)
    frames = load_frames(log, ["front_camera"], ALL, (96, 54), 8)
    mover = next(t for t in log.tracks if t.moving)
    view = frames.training()[3]
    pose = mover.trajectory().at(view.time_us)[:3, 3].numpy()
    eye = log.camera("front_camera").world_from_cam[view.index, :3, 3].numpy()
    middle = pose + [0, 0, 0.7]
    behind, before = eye + 1.4 * (middle - eye), eye + 0.5 * (middle - eye)
    seen = colours(log, frames, np.stack([behind, before]), np.full(2, view.time_us), [mover])
    assert np.isnan(seen[0, 0]).all() and np.isfinite(seen[0, 1]).all()
    box = nearest_box(log.camera("front_camera").camera(view.index), [mover])
    assert np.isfinite(box).any() and not np.isfinite(box).all()


def test_held_out_frames_are_every_fourth_but_those_at_the_ends(drive):
    log = open_log(drive)
    frames = load_frames(log, ["front_camera", "left_camera"], ALL, (48, 27), 4)
    assert [v.index for v in frames.of(0, held_out=True)] == [4]
    assert len(frames.training()) == 14 and frames.views[0].image.dtype == torch.uint8


def test_gains_between_cameras_are_found_from_shared_points():
    generator = np.random.default_rng(0)
    truth = generator.uniform(0.1, 0.7, (5000, 3)).astype(np.float32)
    seen = np.stack([truth, truth * [0.8, 0.9, 1.1], np.full_like(truth, np.nan)])
    seen[0, :2000] = np.nan
    gains = first_exposures(seen)
    np.testing.assert_allclose(gains, [[1, 1, 1], [0.8, 0.9, 1.1], [1, 1, 1]], atol=1e-3)
    np.testing.assert_allclose(merged_colours(seen, gains), truth, atol=1e-3)


def test_thinning_meets_its_budget_and_keeps_more_near_the_path():
    generator = np.random.default_rng(0)
    xyz = generator.uniform([-60, -60, 0], [60, 60, 0.1], (40_000, 3))
    distance = np.linalg.norm(xyz, axis=1)
    chosen, sides = thin(Cloud(xyz, xyz), distance, 5000)
    assert 3500 < len(chosen.xyz) <= 5500 and len(sides) == len(chosen.xyz)
    near = np.linalg.norm(chosen.xyz, axis=1) < 10
    assert near.mean() > 3 * (distance < 10).mean()


@pytest.mark.parametrize("start", [(0.0, -5500.0, 0.0), (-9000.0, 9000.0, 300.0)])
def test_thinning_keeps_as_many_however_far_from_the_start(start):
    xyz = np.random.default_rng(0).uniform([-20, -20, 0], [20, 20, 6], (20_000, 3)) // 0.04 * 0.04 + 0.02
    near, _ = thin(Cloud(xyz, xyz), np.full(len(xyz), 5.0), len(xyz))
    far, _ = thin(Cloud(xyz + start, xyz), np.full(len(xyz), 5.0), len(xyz))
    np.testing.assert_allclose(far.xyz - start, near.xyz, atol=1e-6)


def test_fewer_splats_are_as_much_wider_and_enough_are_left_as_they_are():
    splats = gaussians(40)
    some = fewer(splats, 10.9)
    assert len(some) == 10 and torch.equal(some.means[[0, -1]], splats.means[[0, -1]])
    chosen = [i for mean in some.means for i in (splats.means == mean).all(1).nonzero()[:, 0].tolist()]
    torch.testing.assert_close(some.log_scales.exp(), 2 * splats.log_scales[chosen].exp())
    assert fewer(splats, 40) is splats and len(fewer(splats, 0)) == 0


def test_seeds_of_a_plane_lie_flat_in_it():
    generator = np.random.default_rng(0)
    xyz = np.concatenate([generator.uniform(-2, 2, (2000, 2)), np.zeros((2000, 1))], 1)
    g = splats_from(Cloud(xyz, np.full((2000, 3), 0.5)), np.full(2000, 0.1), 4, 0.5)
    thin_axis = g.log_scales.argmin(1)
    normal = matrix_from_quat(g.quats).gather(2, thin_axis[:, None, None].expand(-1, 3, 1))[..., 0]
    assert (normal[:, 2].abs() > 0.99).all()
    g.validate()


def test_views_are_spread_from_first_to_last():
    assert spread(list(range(10)), 4) == [0, 3, 6, 9] and spread([1], 5) == [1]


def test_where_the_first_camera_lacks_pictures_the_body_goes_as_the_log_has_it():
    """Around a bend; the camera's poses have the body a little aside of where the log has it."""
    times = 100_000 * torch.arange(12)
    bend = torch.stack([yaw(0.05 * i) @ translation(0.0, -15.0, 0.0) for i in range(12)])
    mount, aside = translation(1.0, 0.0, 1.5), translation(0.0, 0.2, 0.0)
    kept = [0, 1, 2, 3, 8, 9, 10, 11]
    camera = LogCamera("front", Pinhole(60.0, 60.0, 48.0, 27.0), 96, 54, (), times[kept], bend[kept] @ aside @ mount)
    log = Log("bend", Path(), {"front": camera}, (), (), Trajectory(times, bend), {})
    views = [View(0, i, int(t), torch.zeros(1, 1, 3), i == 2, torch.zeros(1, 1)) for i, t in enumerate(camera.times_us)]
    path = body_path(log, Frames(["front"], [(96, 54)], views), {"front": RigCamera(camera.lens, 96, 54, mount)})
    torch.testing.assert_close(path.at_each(times), bend @ aside, atol=1e-9, rtol=0)
    bare = replace(log, ego=Trajectory(times[kept], bend[kept]))
    assert len(body_path(bare, Frames(["front"], [(96, 54)], views), {"front": RigCamera(camera.lens, 96, 54, mount)})) == 10


def test_what_all_movers_may_have_goes_to_each_as_evenly_as_they_can_use_it():
    generator = np.random.default_rng(0)
    for total in (50, 400, 5000):
        counts = generator.integers(0, 300, 20).tolist()
        limit = even_limit(counts, total)
        shared, more = (sum(min(n, which) for n in counts) for which in (limit, limit + 1))
        assert shared <= total and (more > total or limit >= max(counts)), "no more than all may have, and no less than they could"
    assert even_limit([5, 5], 20) >= 5 and even_limit([1, 100, 100], 101) == 50 and even_limit([], 10) > 0


def test_the_carpet_takes_the_streets_colour_not_that_of_a_cars_sill():
    """Grey points of the road lie all around a gap; a glint and blue sills, 15 cm up, stand in it."""
    flat, ego = Ground(torch.zeros(41, 41), (-10.0, -10.0), 0.5), Trajectory(torch.zeros(1, dtype=torch.int64), torch.eye(4)[None].double())
    x, y = np.meshgrid(np.arange(-9.9, 9.9, 0.2), np.arange(-9.9, 9.9, 0.2))
    road = np.column_stack([x.ravel(), y.ravel(), 0.02 * np.sin(x.ravel())])
    road = road[np.abs(road[:, :2]).max(1) > 1.5]
    sill = np.array([[0.0, y, 0.15] for y in np.arange(-1, 1, 0.4)])
    rgb = np.concatenate([np.full((len(road), 3), 0.4), np.tile([[0.1, 0.1, 0.9]], (len(sill), 1))])
    points = np.concatenate([road, sill])
    laid = carpet(points, Cloud(points, rgb), flat, ego, 4, 10_000)
    gap = laid.means[:, :2].abs().amax(1) < 1.3
    assert gap.sum() > 20
    torch.testing.assert_close(rgb_from_sh(laid.sh[gap, 0]), torch.full((int(gap.sum()), 3), 0.4), atol=1e-4, rtol=0)


def test_no_carpet_lies_where_points_were_left_out():
    """Of a road that was measured every 20 cm one seed in 2 m is kept: none of the carpet belongs between them."""
    flat, ego = Ground(torch.zeros(41, 41), (-10.0, -10.0), 0.5), Trajectory(torch.zeros(1, dtype=torch.int64), torch.eye(4)[None].double())
    x, y = np.meshgrid(np.arange(-12, 12, 0.2), np.arange(-12, 12, 0.2))
    road = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    seeds = Cloud(road[::100], np.full((len(road[::100]), 3), 0.4))
    assert not len(carpet(road, seeds, flat, ego, 4, 10_000)) and len(carpet(seeds.xyz, seeds, flat, ego, 4, 10_000)) > 1000


def test_on_a_long_way_the_carpet_keeps_to_its_part_and_still_hides_what_is_below():
    """2 km to the north-east: the box around it has a hundred times as many places as lie along it."""
    along = np.arange(0, 1400.0, 3.0)
    poses = torch.stack([translation(float(x), float(x), 1.8) for x in along])
    ego, flat = Trajectory(100_000 * torch.arange(len(along)), poses), Ground(torch.zeros(2, 2), (0.0, 0.0), 1.0)
    road = np.column_stack([along, along - 3, 0 * along])
    laid = carpet(road, Cloud(road, np.full((len(road), 3), 0.4)), flat, ego, 1, 10_000)
    assert 8_000 < len(laid) <= 10_000
    spread = laid.log_scales[0, 0].exp()
    away = cKDTree(laid.means[:, :2].numpy()).query(np.column_stack([along + 5, along + 1]))[0]
    assert (away < 1.0 / 0.75 * float(spread)).all()
    few = carpet(road[:9], Cloud(road[:9], np.full((9, 3), 0.4)), flat, Trajectory(ego.times_us[:9], poses[:9]), 1, 20_000)
    assert few.log_scales[0, 0].exp() == pytest.approx(0.75 * 0.3)


@pytest.mark.parametrize(("ends_at", "shown"), [(14.0, True), (-3.0, False)], ids=["overtakes", "stays behind"])
def test_a_mover_without_lidar_points_looks_as_in_pictures_that_show_it(ends_at, shown):
    """Not as in the one that was taken when it was nearest, since it is beside the camera then."""
    log = painted.drive([0.0] * 8, ("front",))
    places = torch.linspace(-5, ends_at, 8, dtype=torch.float64)
    poses = torch.stack([translation(float(x), 4.0) for x in places])
    times = log.camera("front").times_us.numpy()
    track = Track("veh_1", "car", True, np.array([4.3, 1.8, 1.5]), times, poses, np.full(8, -1), ())
    frames = load_frames(log, ["front"], (0, 10**18), (80, 45), 8)
    split = split_points(log, [], [track])
    made = list(actor_seeds(log, frames, [], split, Ground(torch.zeros(80, 80), (-20.0, -20.0), 0.5), np.ones((1, 3)), 1, 10_000))
    assert [t.name for t, _ in made] == (["veh_1"] if shown else [])
    assert all(len(seeds) > 100 for _, seeds in made)
