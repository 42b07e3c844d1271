import numpy as np
import pytest
import torch
from painted import AHEAD, BOARD, HEIGHT, SIZE, WALL, board_left, depth_of, drive

from recon.ground import estimate_ground
from recon.log import SparsePoints, Track
from recon.seeds import dense, stereo
from recon.seeds.dense import DUG, _chosen, agreed, agreeing, cloud_from_pictures, companions, depths, ground_depth
from recon.seeds.stereo import plate_of
from recon.seeds.triangulate import triangulated
from recon.views.frames import load_frames
from scenes.camera import Camera
from scenes.ground import Ground
from scenes.lenses import Fisheye, OpenCV, Pinhole
from scenes.poses import translation

ALL = (0, 10**18)
STEPS = [0.0] + [0.6] * 11

pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")


def _started(log):
    frames = load_frames(log, list(log.cameras), ALL, SIZE, 8)
    points = triangulated(log, frames)
    return frames, points, estimate_ground(points.xyz, log.ego)


@pytest.fixture(scope="module", autouse=True)
def few_pictures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dense, "VIEWS", (6, 10))
        patch.setattr(stereo, "WIDTH", 160)
        yield


@pytest.fixture(scope="module")
def plain():
    log = drive(STEPS, ("front",))
    return log, *_started(log)


@pytest.fixture(scope="module")
def crossed():
    log = drive(STEPS, ("front",), board=True)
    return log, *_started(log)


def _off(made, until=99):
    """Relative errors of the depths that pictures agree on, and which part of the pixels of those before `until` that is."""
    log, frames, points, ground = made
    found = depths(log, frames, points, ground)
    errors, share = [], []
    for own, mask in zip(found, agreed(found), strict=True):
        if own.view.index < until:
            camera = log.camera(frames.names[own.view.camera]).camera(own.view.index, *SIZE)
            truth = depth_of(camera.resized(*own.depth.shape[::-1])).numpy()
            errors.append(np.abs(own.depth / truth - 1)[mask])
            share.append(mask.mean())
    return np.concatenate(errors), np.array(share)


def test_depths_are_those_of_what_pictures_show(plain):
    errors, share = _off(plain)
    assert np.median(errors) < 0.015 and (errors < 0.05).mean() > 0.9
    assert len(share) == 6 and share.mean() > 0.6


def test_a_car_that_stands_before_it_goes_learns_depth_from_where_it_went():
    log = drive([0.0] * 6 + [0.6] * 8, ("front",))
    errors, share = _off((log, *_started(log)), until=5)
    assert np.median(errors) < 0.03 and len(share) >= 2 and share.mean() > 0.35


def test_what_moves_is_no_seed_and_what_stands_behind_it_is(plain, crossed):
    def beside(made):
        """How many seeds stand where the board was when any picture was taken, and how many on the wall."""
        log, frames, points, ground = made
        cloud, _ = cloud_from_pictures(log, frames, points, agreeing(log, frames, points, ground), [], np.ones((2, 3)))
        x, y, z = cloud.xyz.T
        path = (y > board_left(0)) & (y < board_left(len(STEPS)) + BOARD)
        board = path & (np.abs(x - AHEAD) < 0.5) & (z > 0.4) & (z < 1.8)
        return board.sum(), (np.abs(x - WALL) < 1).sum()

    board, wall = beside(crossed)
    assert beside(plain)[0] == 0 and wall > 2_000
    assert board < 0.003 * wall


def test_seeds_keep_off_movers_and_the_sky(plain):
    log, frames, points, ground = plain
    ahead = translation(10.0, 0.0, 0.0).expand(9, 4, 4)
    car = Track("veh_1", "car", True, np.array([4.0, 2.0, 1.5]), np.arange(9) * 100_000, ahead, np.zeros(9), ())
    seen = agreeing(log, frames, points, ground)
    free, kept = (cloud_from_pictures(log, frames, points, seen, movers, np.ones((2, 3)))[0] for movers in ([], [car]))
    assert 0.3 * len(free.xyz) < len(kept.xyz) < len(free.xyz) - 100
    assert (free.rgb >= 0).all() and (free.rgb <= 1).all() and free.xyz[:, 2].min() > -1
    for view in frames.views:
        view.sky[: len(view.sky) // 3] = True
    try:
        assert cloud_from_pictures(log, frames, points, seen, [], np.ones((2, 3)))[0].xyz[:, 2].max() < free.xyz[:, 2].max() - 1
    finally:
        for view in frames.views:
            view.sky[:] = False


@pytest.mark.parametrize("lens", [OpenCV(160, 160, 160, 90, -0.2, 0.05, 1e-3, 1e-3), Fisheye(150, 150, 158, 92, 0.02)])
def test_a_plate_undoes_its_lens(lens):
    pose = translation(1.0, 2.0, 3.0)
    plate = plate_of(torch.zeros(180, 320, 3, dtype=torch.uint8), Camera(lens, *SIZE, pose))
    points = np.random.default_rng(0).uniform([-3, -2, 4], [3, 2, 9], (500, 3)) + [1.0, 2.0, 3.0]
    row, column, z, inside = plate.shown(points)
    assert inside.mean() > 0.8 and np.allclose(z, points[:, 2] - 3)
    there = lens.project(torch.from_numpy(points) - pose[:3, 3]).numpy()
    shown = plate.at.numpy()[row, column]
    assert np.abs(shown - there)[inside & plate.inside[row, column]].max() < 2.0  # a pixel of the plate is two wide here


def test_pictures_are_compared_with_those_before_and_after_that_stand_apart_and_look_the_same_way():
    flat = torch.zeros(18, 32, 3, dtype=torch.uint8)
    lens = Pinhole(30, 30, 16, 9)
    half_turn = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    poses = [translation(0.0, 0.0, 0.5 * i) for i in range(20)] + [translation(0.0, 0.0, 6.0) @ half_turn]
    plates = [plate_of(flat, Camera(lens, 32, 18, p)) for p in poses]
    assert companions(10, plates, 20.0) == [8, 2, 12, 18]  # 1.2 and 4 metres
    assert companions(0, plates, 20.0) == [2, 8]
    assert companions(20, plates, 20.0) == []
    assert companions(10, [plates[10]] * 20, 20.0) == []


def test_a_long_way_is_looked_at_more_often():
    flat, lens = torch.zeros(18, 32, 3, dtype=torch.uint8), Pinhole(30, 30, 16, 9)
    plates = [plate_of(flat, Camera(lens, 32, 18, translation(0.0, 0.0, 0.5 * i))) for i in range(41)]
    points = [p.eye() + [[0.0, 0.0, z] for z in (5.0, 20.0, 30.0)] for p in plates]
    assert len(_chosen(plates, points)) == 6  # 20 metres, at 20 metres
    # 20 metres, at 3 metres: the ends, and what they are compared with
    assert _chosen(plates, [(p - q.eye()) / 7 + q.eye() for p, q in zip(points, plates, strict=True)]) == [0, 1, 39, 40]
    assert _chosen(plates, [np.zeros((0, 3))] * 41) == []


def test_the_ground_is_as_far_as_rays_have_to_go_to_it():
    heights = torch.zeros(400, 400)
    ground = Ground(heights, (-100.0, -100.0), 0.5)
    camera = drive([0.0]).camera("front").camera(0, *SIZE)
    found = ground_depth(plate_of(torch.zeros(180, 320, 3, dtype=torch.uint8), camera), ground, DUG)
    rays = depth_of(camera.resized(160, 90)).numpy()
    below = rays < WALL - 1
    eye = float(camera.world_from_cam[2, 3])
    np.testing.assert_allclose(found[below], rays[below] * (eye + DUG) / eye, rtol=1e-3)
    assert np.isinf(found[:40]).all()
    assert (found[50:] > 0).all()


def _exact(log, frames):
    """As if structure from motion had found points all over the first plates: what the painted drive really shows."""
    seen, xyz = {}, []
    for name in frames.names:
        seen[name] = [np.zeros(0, np.int64)] * len(log.camera(name))
        for view in frames.training():
            camera = log.camera(name).camera(view.index, 32, 18)
            depth = depth_of(camera)
            rays = camera.lens.unproject(camera.pixel_centres()) * depth[..., None]
            pose = camera.world_from_cam
            points = (rays.reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3])[depth.flatten() < 100].numpy()
            seen[name][view.index] = sum(map(len, xyz)) + np.arange(len(points))
            xyz.append(points)
    return SparsePoints(np.concatenate(xyz), {name: tuple(of) for name, of in seen.items()})


def test_a_ground_that_is_wrong_makes_no_depths():
    log = drive(STEPS, ("front",))
    frames = load_frames(log, ["front"], ALL, SIZE, 8)
    points = _exact(log, frames)
    few = SparsePoints(points.xyz, {"front": tuple(s[(points.xyz[s, 2] > 0.2)] for s in points.seen["front"])})  # none on the ground
    for up, shown in ((0.5, few), (0.9, points), (30.0, points)):
        errors, share = _off((log, frames, shown, Ground(torch.full((400, 400), up), (-100.0, -100.0), 0.5)))
        assert (errors < 0.1).mean() > 0.95 and share.mean() > 0.15, up


def test_nothing_is_looked_for_under_a_road_that_points_show_however_many_seem_to_be_there():
    log = drive(STEPS, ("front",))
    frames = load_frames(log, ["front"], ALL, SIZE, 8)
    noise = torch.Generator().manual_seed(3)
    for view in frames.views:  # a road of which pictures tell nothing
        view.image[100:] = torch.randint(100, 140, (80, 320, 3), generator=noise, dtype=torch.uint8)
    points = _exact(log, frames)
    sunken = np.random.default_rng(4).uniform((5.0, 30.0, -9.0), (15.0, 60.0, -1.0), (len(points.xyz), 3))  # beside it, in every picture
    shown = tuple(np.concatenate([s, len(points.xyz) + np.arange(len(s))]) for s in points.seen["front"])
    both = SparsePoints(np.concatenate([points.xyz, sunken]), {"front": shown})
    for own in depths(log, frames, both, estimate_ground(points.xyz, log.ego)):
        below = depth_of(own.camera.resized(*own.depth.shape[::-1])).numpy()[55:]
        assert np.nanmax(own.depth[55:] / below) < 1 + 1.2 * DUG / HEIGHT


def test_what_moves_with_the_camera_is_not_believed():
    log = drive(STEPS, ("front",))
    frames = load_frames(log, ["front"], ALL, SIZE, 8)
    stamp = torch.randint(0, 255, (40, 80, 3), generator=torch.Generator().manual_seed(2), dtype=torch.uint8)
    for view in frames.views:
        view.image[:40, 120:200] = stamp
    points = _exact(log, frames)
    found = depths(log, frames, points, estimate_ground(points.xyz, log.ego))
    believed = np.mean([mask[2:18, 62:98] for mask in agreed(found)])
    assert believed < 0.1


def test_pictures_far_apart_and_few_begin_with_what_there_is():
    for steps in ([0.0, 8.0], [0.0, 0.8], [0.0, 9.0, 9.0]):
        log = drive(steps, ("front",))
        frames = load_frames(log, ["front"], ALL, SIZE, 0)
        points = _exact(log, frames)
        seen = agreeing(log, frames, points, estimate_ground(points.xyz, log.ego))
        cloud, _ = cloud_from_pictures(log, frames, points, seen, [], np.ones((2, 3)))
        assert len(cloud.xyz) >= 300, steps
