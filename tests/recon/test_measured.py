from dataclasses import replace

import numpy as np
import pytest
import torch
from painted import SIZE, drive, sweep_of, wall

from recon.log import LidarPoints, Sweep, Track
from recon.objects.actors import split_points
from recon.seeds.measured import (
    LATE_US,
    SLACK,
    SOON_US,
    Measured,
    by_lidar,
    by_lidar_of_movers,
    by_pictures,
    grid_of,
    mistake,
    nearest_points,
)
from recon.seeds.stereo import plate_of
from recon.views.frames import Frames, load_frames
from recon.views.view import View
from scenes.camera import Camera
from scenes.lenses import Fisheye, OpenCV, Pinhole
from scenes.poses import translation

ALL = (0, 10**18)


def _by_lidar(log, frames, sweeps, movers):
    return by_lidar(log, frames, sweeps, split_points(log, sweeps, movers), movers)


def test_lidar_measures_what_the_camera_sees_and_stands_still():
    log = drive([0.0, 0.5, 0.5], ("front",))
    frames = load_frames(log, ["front"], ALL, SIZE, 0)
    car = Track(
        "veh_1",
        "car",
        True,
        np.array([1.0, 2.0, 3.0]),
        np.array([20_000, 10**6]),
        translation(6.0, -3.0, 0.0).expand(2, 4, 4),
        np.zeros(2),
        (),
    )
    sweep = sweep_of(20_000, wall(12.0, -3, 3), wall(8.0, 0, 1), wall(6.0, -4, -2))
    measured = _by_lidar(log, frames, [sweep], [car]).views
    depth = measured[0, 0].float().numpy()
    known = depth[np.isfinite(depth)]
    far, near = np.abs(known - 12) < 0.05, np.abs(known - 8) < 0.05
    assert (far | near).all() and near.sum() > 100 and far.sum() > 500  # and nothing of the car at 6
    # behind the board nothing of the wall is left
    columns = np.nonzero((np.abs(depth - 8) < 0.05).any(0))[0]
    board = depth[:, columns.min() + 2 : columns.max() - 2]
    assert not (np.abs(board[np.isfinite(board)] - 12) < 0.05)[: near.sum() // 2].all()
    # a lens that sees far aside means the distance
    round_ = replace(log, cameras={"front": replace(log.cameras["front"], lens=Fisheye(100, 100, 160, 90))})
    distance = _by_lidar(round_, frames, [sweep_of(20_000, wall(12.0, -12, 12))], []).views[0, 0].float().numpy()
    assert np.nanmax(distance) == pytest.approx(17.0, abs=0.3) and np.nanmin(distance) == pytest.approx(12.0, abs=0.1)
    assert (0, 1) in measured
    assert _by_lidar(log, frames, [], []).views == {}


@pytest.mark.parametrize(
    ("late", "way", "seen"), [(SOON_US, 3.0, True), (SOON_US + 1, 3.0, False), (SOON_US + 1, 0.9, True), (LATE_US + 1, 0.0, False)]
)
def test_a_sweep_measures_what_is_seen_soon_or_from_about_the_same_place(late, way, seen):
    log = drive([0.0, 0.0, way], ("front",))
    frames = load_frames(log, ["front"], ALL, SIZE, 0)
    assert frames.views[2].time_us == 200_000
    assert ((0, 2) in _by_lidar(log, frames, [sweep_of(200_000 - late, wall(12.0, -3, 3))], []).views) == seen


def test_lidar_measures_what_moves_where_it_is_when_the_picture_is_taken():
    log = drive([0.0, 0.5, 0.5], ("front",))
    frames = load_frames(log, ["front"], ALL, SIZE, 0)
    poses = torch.stack([translation(6.5 - 0.2, 0.0, 0.0), translation(6.5, 0.0, 0.0), translation(9.3, 0.0, 0.0)])
    car = Track("veh_1", "car", True, np.array([1.0, 2.0, 3.0]), np.array([0, 20_000, 300_000]), poses, np.zeros(3), ())
    back, post, cars = wall(6.0, -1, 1), wall(4.0, -0.2, 0.2), [car]

    def seen(*parts):
        sweep = sweep_of(20_000, *parts)
        return by_lidar_of_movers(log, frames, [sweep], split_points(log, [sweep], cars)).views

    measured = seen(back, wall(12.0, -3, 3))
    depth = measured[0, 0].float().numpy()  # at 10 m/s it was 20 cm nearer 20 ms before
    known = np.isfinite(depth)
    assert known.sum() > 200 and np.abs(depth[known] - 5.8).max() < 0.05
    later = measured[0, 1].float().numpy()
    assert np.nanmedian(later) == pytest.approx(6.8 - 0.5, abs=0.05), "where it is by then"
    hidden = known & ~np.isfinite(seen(back, post)[0, 0].float().numpy())
    assert hidden.sum() > 20 and (np.nonzero(hidden.any(0))[0] - known.shape[1] / 2 < 20).all(), "behind the post"
    assert seen(wall(12.0, -3, 3)) == {}
    cars.append(replace(car, name="veh_2", world_from_box=translation(3.0, 0.0, 0.0).expand(3, 4, 4)))
    now, later = sweep_of(20_000, back, wall(12.0, -3, 3)), replace(sweep_of(300_000, wall(3.0, -1, 1)), index=1)
    for sweeps in ([now], [now, later]):
        depth = by_lidar_of_movers(log, frames, sweeps, split_points(log, sweeps, cars)).views[0, 0]
        assert not depth.isfinite().any(), "behind a car that this sweep did not strike"


def test_depths_are_completed_where_there_are_none():
    nan = torch.nan
    ours = Measured({(0, 0): torch.tensor([[1.0, nan]]).half(), (0, 1): torch.tensor([[nan]]).half()}, 0.5)
    theirs = Measured({(0, 0): torch.tensor([[3.0, 4.0]]).half(), (0, 2): torch.tensor([[5.0]]).half()}, 9.0)
    both = ours.completed(theirs)
    assert both.weight == 0.5 and {which: depth.tolist() for which, depth in both.views.items() if which != (0, 1)} == {
        (0, 0): [[1.0, 4.0]],
        (0, 2): [[5.0]],
    }
    assert both.views[0, 1].isnan().all()


AHEAD = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]], dtype=torch.float64)
"""A camera 1.6 m above the road that looks along x."""


def _struck(size, apart, *fences):
    """Depth on the grid of a camera of a size, as beams `apart` degrees, from 1.9 m above, strike the road and fences: x ahead, from z to
    z. And how far away the bare road is."""
    camera = grid_of(Camera(Pinhole(700, 700, size[0] / 2, size[1] / 2), *size, AHEAD))
    down, turn = np.meshgrid(np.radians(np.arange(-10, 25, apart)), np.radians(np.arange(-30, 30, 0.1)), indexing="ij")
    ray = np.stack([np.ones_like(down), np.tan(turn), -np.tan(down) / np.cos(turn)], -1).reshape(-1, 3)
    with np.errstate(divide="ignore"):
        first = np.where(ray[:, 2] < 0, -1.9 / ray[:, 2], np.inf)
    for x, low, high in fences:
        z = 1.9 + x * ray[:, 2]
        first = np.where((z > low) & (z < high), np.minimum(first, x), first)
    points = np.array([0, 0, 1.9]) + ray[np.isfinite(first)] * first[np.isfinite(first)][:, None]
    rays = camera.lens.unproject(camera.pixel_centres()).numpy()
    nowhere = np.full(rays.shape[:2], np.inf)
    return nearest_points(points, camera, nowhere), 1.6 / np.maximum(rays[..., 1] / rays[..., 2], 1e-9)


@pytest.mark.parametrize("size", [(960, 540), (1242, 375)])
@pytest.mark.parametrize("apart", [0.42, 0.17])
def test_a_road_hides_nothing_of_itself(size, apart):
    road, bare = _struck(size, apart)
    for near, far in ((6, 12), (12, 20), (20, 30)):
        band = (bare > near) & (bare < far)
        there = np.isfinite(road[band])
        off = road[band][there] / bare[band][there] - 1
        # rows of the grid are 0.31 and 0.4 degrees apart
        assert there.mean() > 0.5, (near, far)
        assert abs(off.mean()) < 0.015 and np.abs(off).max() < 0.2, (near, far)


def test_a_floor_hides_nothing_of_itself_from_a_robots_camera():
    """0.3 m above it: taken for a car's, whose road is never so steep, what lies some metres ahead is hidden by what lies before it."""
    down, turn = np.meshgrid(np.radians(np.arange(1, 15, 0.5)), np.radians(np.arange(-30, 30, 0.2)), indexing="ij")
    away = 0.45 / np.tan(down)
    floor = np.stack([away * np.cos(turn), away * np.sin(turn), np.zeros_like(away)], -1).reshape(-1, 3)
    pose = AHEAD.clone()
    pose[2, 3] = 0.3
    log = drive([0.0, 0.5], ("front",))
    camera = replace(log.cameras["front"], lens=Pinhole(190, 190, 160, 120), width=320, height=240, world_from_cam=pose.expand(2, 4, 4))
    log = replace(log, cameras={"front": camera})
    views = [View(0, 0, 20_000, torch.zeros(240, 320, 3, dtype=torch.uint8), False, torch.zeros(1, 1, dtype=torch.bool))]
    sweep = Sweep(0, 20_000, lambda: LidarPoints(floor, np.full(len(floor), 20_000), np.zeros(len(floor), np.int64)))
    (depth,) = _by_lidar(log, Frames(["front"], [(320, 240)], views), [sweep], []).views.values()
    grid = grid_of(log.cameras["front"].camera(0))
    cars = nearest_points(floor, grid, np.full(depth.shape, np.inf))
    known = int(depth.isfinite().sum())
    assert known > 1.3 * np.isfinite(cars).sum()


@pytest.mark.parametrize("size", [(960, 540), (1242, 375)])
@pytest.mark.parametrize("apart", [0.42, 1.33])
@pytest.mark.parametrize("fence", [(8, 0, 0.7), (8, 0, 1.2), (8, 0, 1.62), (12, 0, 1.0)])
def test_a_fence_over_which_only_the_lidar_looks_hides_what_is_behind(size, apart, fence):
    found, bare = _struck(size, apart, fence)
    x, _, height = fence
    hidden = bare < x * 1.6 / max(1.6 - height, 1e-9)  # the camera's ray to that road meets the fence
    behind = hidden & (bare > x)
    assert (behind & (np.abs(found - x) < 0.1)).sum() > 20
    assert (behind & (found > 1.1 * x)).sum() == 0


def test_above_the_horizon_what_is_lower_hides_too():
    found, _ = _struck((960, 540), 0.42, (20, 1.9, 3.0), (23, 1.9, 3.4))
    rows = np.nonzero((np.abs(found - 20) < 0.1).any(1))[0]
    assert (np.abs(found[: rows.min()] - 23) < 0.1).sum() == 0
    assert len(rows) > 3


@pytest.mark.parametrize(
    "lens", [Pinhole(160, 150, 158, 92), OpenCV(160, 160, 160, 90, -0.2, 0.05, 1e-3, 1e-3), Fisheye(150, 150, 158, 92)]
)
def test_pictures_depths_come_to_the_pixels_of_their_lens(lens):
    camera = Camera(lens, *SIZE, translation(0.0, 0.0, 0.0))
    plate = plate_of(torch.zeros(SIZE[1], SIZE[0], 3, dtype=torch.uint8), camera)

    def slope(rays: np.ndarray) -> np.ndarray:
        """How many of them lead to the plane x + 2 z = 20."""
        return 20 / (2 * rays[..., 2] + rays[..., 0])

    depth = slope(plate.rays().numpy())
    depth[:10] = np.nan
    found = by_pictures(plate, np.where(plate.inside, depth, np.nan), camera).float().numpy()
    grid = grid_of(camera)
    truth = slope(grid.lens.unproject(grid.pixel_centres()).numpy())
    known = np.isfinite(found)
    assert found.shape == truth.shape and known.mean() > 0.55 and not known[:5].any()
    np.testing.assert_allclose(found[known], truth[known], rtol=5e-3)


def test_a_mistake_costs_where_something_is_known_and_drawn():
    depth = torch.full((8, 16), 10.0, requires_grad=True)
    alpha, known = torch.ones(8, 16), torch.full((1, 4, 8), 10.0).half()
    assert mistake(depth, alpha, known) == 0
    known[0, 0, 0], known[0, 1] = 10 / (1 + SLACK), torch.nan
    alpha[4:] = 0.2
    cost = mistake(depth, alpha, known)
    both = mistake(depth, alpha, torch.cat([torch.full_like(known, 10), known]))
    assert both.tolist() == [0, cost]
    assert float(cost.detach()) == pytest.approx(np.log(2) / 8, rel=1e-2)  # half of the rows are drawn, half of those known
    cost.backward()
    assert depth.grad is not None and (depth.grad != 0).sum() == 1 and depth.grad[1, 1] > 0
    nothing = torch.full((1, 4, 8), torch.nan)
    empty = mistake(torch.full((8, 16), torch.inf, requires_grad=True), alpha, nothing)
    assert empty == 0
    empty.backward()
