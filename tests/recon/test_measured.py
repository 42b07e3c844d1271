from dataclasses import replace

import numpy as np
import pytest
import torch
from painted import SIZE, drive, sweep_of, wall

from recon.actors import split_points
from recon.frames import load_frames
from recon.log import Track
from recon.seeds.measured import SLACK, SOON_US, by_lidar, by_pictures, grid_of, mistake, nearest_points
from recon.seeds.stereo import plate_of
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
    assert (0, 1) in measured and (0, 2) not in _by_lidar(log, frames, [sweep_of(200_000 - SOON_US - 1, wall(12.0, -3, 3))], []).views
    assert _by_lidar(log, frames, [], []).views == {}


def _swept(stop):
    """Where beams 0.42 degrees apart, from 1.9 m above the road, strike it or what `stop` [N, 3] -> [N] says stands there, x ahead."""
    down, turn = np.meshgrid(np.radians(np.arange(1.5, 25, 0.42)), np.radians(np.arange(-30, 30, 0.1)), indexing="ij")
    ray = np.stack([np.cos(turn), np.sin(turn), -np.tan(down)], -1).reshape(-1, 3)
    return np.array([0, 0, 1.9]) + ray * np.minimum(1.9 / -ray[:, 2], stop(ray))[:, None]


@pytest.mark.parametrize("size", [(960, 540), (1242, 375)])
def test_a_road_hides_nothing_of_itself_and_a_fence_does(size):
    forward = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]], dtype=torch.float64)
    whole = Camera(Pinhole(700, 700, size[0] / 2, size[1] / 2), *size, forward)
    camera = grid_of(whole)
    rays = camera.lens.unproject(camera.pixel_centres()).numpy()
    falls = np.maximum(rays[..., 1] / rays[..., 2], 1e-9)

    def known(stop):
        return nearest_points(_swept(stop), camera, np.full(falls.shape, np.inf))

    bare, road = 1.6 / falls, known(lambda ray: np.full(len(ray), np.inf))
    for near, far in ((6, 12), (12, 20), (20, 30)):
        band = (bare > near) & (bare < far)
        there = np.isfinite(road[band])
        # beams are 0.42 degrees apart, rows of the grid 0.31 and 0.4
        assert there.mean() > 0.5, (near, far)
        assert np.abs(road[band][there] / bare[band][there] - 1).max() < 0.2
    # a fence 1.62 m high, 8 m ahead, over which the lidar looks and the camera does not
    fence = known(lambda ray: np.where(1.9 + 8 * ray[:, 2] / ray[:, 0] < 1.62, 8 / ray[:, 0], np.inf))
    behind = np.isfinite(fence) & (fence > 8.5)
    assert (np.isfinite(fence) & (np.abs(fence - 8) < 0.1)).sum() > 1000
    assert behind.sum() == 0


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
    alpha, known = torch.ones(8, 16), torch.full((4, 8), 10.0).half()
    assert mistake(depth, alpha, known) == 0
    known[0, 0], known[1] = 10 / (1 + SLACK), torch.nan
    alpha[4:] = 0.2
    cost = mistake(depth, alpha, known)
    assert float(cost.detach()) == pytest.approx(np.log(2) / 8, rel=1e-2)  # half of the rows are drawn, half of those known
    cost.backward()
    assert depth.grad is not None and (depth.grad != 0).sum() == 1 and depth.grad[1, 1] > 0
    nothing = torch.full((4, 8), torch.nan)
    empty = mistake(torch.full((8, 16), torch.inf, requires_grad=True), alpha, nothing)
    assert empty == 0
    empty.backward()
