"""The road of a drive without lidar lies as far below the path everywhere, whatever the points say that pictures agree on."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from painted import HEIGHT, SIZE, drive

from recon.ground import estimate_ground
from recon.seeds.dense import Depths
from recon.seeds.road import KERB, OFF, WIDE, WIDEST, Road, road_by_pictures
from recon.seeds.stereo import plate_of
from recon.views.view import View
from recon.way import Path
from scenes.camera import Camera
from scenes.ground import Ground
from scenes.lenses import Pinhole
from scenes.poses import CAM_FROM_FLU, inverse, translation
from scenes.trajectory import Trajectory

EVER = (0, 10**9)


@pytest.fixture(scope="module")
def log():
    return drive([0.0] + [1.0] * 11, ("front",))


def points(log, waves: float, off: float = 0.0) -> np.ndarray:
    """Points of the ground under a drive, in waves of some metres' length, and off it by as much as they are."""
    x, y = np.meshgrid(np.arange(-5, 25, 0.1), np.arange(-6, 6, 0.1))
    noise = np.random.default_rng(0).normal(0, 0.2, x.shape) * (waves > 0)
    z = off + waves * np.sign(np.sin(x / 1.5)) + noise
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def found(log, shown: np.ndarray, span=EVER):
    return road_by_pictures(log, ["front"], log.ego, span, shown, estimate_ground(shown, log.ego))


def test_a_road_that_points_show_in_waves_goes_along_with_the_path(log, capsys):
    road = found(log, points(log, 0.25, -0.1))
    told = capsys.readouterr().err
    assert "road in waves of" in told and "taken to be 1.5" in told
    assert np.abs(road.ground.heights.numpy()[road.slack > 0]).max() < 0.02, "not where points are in the mean"
    lies = road.points()
    assert len(lies) > 400 and np.abs(lies[:, 2]).max() < 0.02
    across = np.abs(lies[:, 1] - lies[:, 0] / 12)
    assert across.max() < WIDE + 0.5 and (lies[:, 0] > 18).any(), "goes on beyond the last picture"
    beside = road.slack[(road.slack > 0) & (road.slack < OFF)]
    assert KERB < beside.min() == beside.max() < OFF


@pytest.mark.parametrize("kerb", [None, 6.0])
def test_a_road_is_as_wide_as_nothing_stands_on_it(log, kerb):
    """To the left of its path there is a barrier, or none; to the right there are points for eight metres."""
    x, y = np.meshgrid(np.arange(-5, 25, 0.1), np.arange(-8, 14, 0.1))
    z = 0.1 * (x // 4 % 3 - 1) + np.random.default_rng(0).normal(0, 0.02, x.shape)
    z += np.where(kerb is not None and y > kerb, np.arange(len(y))[:, None] % 5 / 5, 0.0)
    lies = found(log, np.column_stack([x.ravel(), (y + x / 12).ravel(), z.ravel()])).points()
    middle = (lies[:, 0] > 2) & (lies[:, 0] < 10)
    across = (lies[:, 1] - lies[:, 0] / 12)[middle]
    assert across.min() == pytest.approx(-8, abs=0.6) and across.max() == pytest.approx(WIDEST if kerb is None else kerb, abs=0.6)


def test_a_world_of_no_metres_is_left_as_it_is(log):
    assert found(replace(log, meta={"metric": False}), points(log, 0.25, -0.1)) is None


def test_where_points_show_it_well_nothing_is_done(log):
    assert found(log, points(log, 0.0)) is None
    assert found(log, points(log, 0.25)[:: 40 * 40]) is None, "too few"


def test_a_path_that_does_not_go_along_the_road_tells_nothing_of_it(log):
    """Of one who flies: what lies under it where it is high would be taken to be under the road, and dropped."""
    poses = log.ego.world_from_body.clone()
    poses[:, 2, 3] += torch.arange(len(poses)) / 2
    flown = replace(log, ego=replace(log.ego, world_from_body=poses))
    assert found(flown, points(log, 0.01), span=(0, 0)) is None


def test_a_slow_drive_with_many_poses_a_second_has_a_path():
    places = torch.stack([translation(0.03 * i, 0.0, HEIGHT) for i in range(1000)])
    path = Path(Trajectory(10_000 * torch.arange(1000), places))
    assert abs(path.length - 29.97) < 0.1
    shaken = places.clone()
    shaken[:, 0, 3] = 0.02 * (torch.arange(1000) % 2)
    assert Path(Trajectory(10_000 * torch.arange(1000), shaken)).length == 0, "stands"


def test_what_is_as_high_as_a_low_camera_is_not_the_road(log):
    down = translation(0, 0, -0.9)
    low = {name: replace(c, world_from_cam=down @ c.world_from_cam) for name, c in log.cameras.items()}
    ego = replace(log.ego, world_from_body=down @ log.ego.world_from_body)
    road = found(replace(log, cameras=low, ego=ego), points(log, 0.25), span=(0, 0))
    assert 0.2 < road.slack.max() < 0.45


def test_pictures_that_show_nothing_leave_it_where_points_are_in_the_middle(log):
    plain = {name: replace(c, files=(c.files[0],) * len(c.files)) for name, c in log.cameras.items()}
    road = found(replace(log, cameras=plain), points(log, 0.25, -0.1))
    heights = road.ground.heights.numpy()[road.slack > 0]
    assert np.ptp(heights) < 1e-5 and 0.02 < np.abs(heights[0]) < 0.5


def test_depths_that_may_be_the_road_lie_on_it_and_none_are_under_it():
    camera = Camera(Pinhole(160, 160, 160, 90), *SIZE, translation(0, 0, HEIGHT) @ inverse(CAM_FROM_FLU))
    plate = plate_of(torch.zeros(SIZE[1], SIZE[0], 3, dtype=torch.uint8), camera)
    slack = np.zeros((80, 80))
    slack[30:50] = OFF
    road = Road(Ground(torch.zeros(80, 80), (0.0, -20.0), 0.5), slack)
    rays = plate.rays().double().numpy() @ np.linalg.inv(plate.cam_from_world)[:3, :3].T
    down = -HEIGHT / np.minimum(rays[..., 2], -1e-3)
    view = View(0, 0, 0, torch.zeros(SIZE[1], SIZE[0], 3, dtype=torch.uint8), False, torch.zeros(1, 1, dtype=torch.bool))
    far = (down < 15) & (rays[..., 2] < -0.05)
    for part, kept in ((0.9, True), (1.1, True), (0.5, False), (1.8, False)):
        own = Depths(view, camera, plate, np.where(far, part * down, np.nan)).on(road)
        within = far & (np.abs(max(part, 1.0) * down * rays[..., 1]) < 4.5)
        depth, road_depth = own.depth[within], down[within]
        if kept:
            assert np.abs(depth / road_depth - 1).max() < 1e-3
        elif part < 1:
            assert np.allclose(depth, part * road_depth), "something stands there"
        else:
            assert np.isnan(depth).all(), "nothing is under the road"
        aside = far & (np.abs(part * down * rays[..., 1]) > 5.5)
        assert np.allclose(own.depth[aside], part * down[aside])
    assert np.isnan(own.depth[~far]).all()
