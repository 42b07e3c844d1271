from dataclasses import replace

import numpy as np
import pytest
import torch
from painted import SIZE, drive, sweep_of, wall

from recon.actors import split_points
from recon.frames import load_frames
from recon.log import Track
from recon.seeds.measured import SLACK, SOON_US, by_lidar, by_pictures, grid_of, mistake
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
