"""How far off a camera that looks straight at places would have to be to see them as finely as a drive's cameras do."""

import math

import numpy as np
import pytest
import torch

from recon.seeds.fineness import seen_from
from scenes.ground import Ground
from scenes.poses import translation, yaw
from scenes.trajectory import Trajectory
from tests.bench.worlds.place import fisheye, looking

HIGH, WIDE = 1.5, 40.0
"""The camera's height, metres, and its pictures' width, degrees; they are square."""

SLOPE = math.tan(math.radians(WIDE) / 2)
FLAT = Ground(torch.zeros(2, 2), (0.0, 0.0), 1.0)


def camera(turned: float = 0.0, angle: float = WIDE):
    return looking((100, 100), angle, turned, (0.0, 0.0, HIGH), torch.zeros(1, dtype=torch.int64))


@pytest.fixture
def straight() -> Trajectory:
    """50 m ahead over flat ground, in steps of 25 cm."""
    return Trajectory(100_000 * torch.arange(201), torch.stack([translation(0.25 * i) for i in range(201)]))


def test_the_road_under_the_path_is_seen_from_where_the_picture_ends(straight):
    found = seen_from(np.array([[30.0, 0.0, 0.0], [30.0, 0.5, 0.0]]), FLAT, straight, [camera()], 3.0)
    depth = HIGH / SLOPE
    assert found == pytest.approx(max(3.0, depth * math.sqrt(depth / HIGH)), rel=0.2)


def test_a_wall_beside_the_path_is_seen_from_behind_it_and_not_aslant(straight):
    found = seen_from(np.array([[40.0, 8.0, 3.0]]), FLAT, straight, [camera()], 3.0)
    assert found[0] == pytest.approx(8.0 / SLOPE, rel=0.15)
    assert seen_from(np.array([[40.0, 8.0, 0.0]]), FLAT, straight, [camera()], 3.0)[0] == pytest.approx(
        8.0 / SLOPE * math.sqrt(8.0 / SLOPE / HIGH), rel=0.25
    )


def test_a_camera_that_looks_there_sees_it_from_nearby(straight):
    wall = np.array([[40.0, 8.0, 2.0]])
    assert seen_from(wall, FLAT, straight, [camera(), camera(90.0)], 3.0)[0] == pytest.approx(8.0, rel=0.1)
    coarse = camera(90.0, 110.0)  # as many pixels of a wider view
    times = camera().lens.focal()[0] / coarse.lens.focal()[0]
    assert seen_from(wall, FLAT, straight, [camera(), coarse], 3.0)[0] == pytest.approx(min(8.0 / SLOPE, 8.0 * times), rel=0.15)
    around = fisheye((100, 100), 190.0, (0.0, 0.0, HIGH), torch.zeros(1, dtype=torch.int64))
    assert seen_from(wall, FLAT, straight, [around], 3.0)[0] == pytest.approx(8.2, rel=0.1)


def test_what_no_camera_sees_is_as_far_off_as_the_path(straight):
    behind = np.array([[-20.0, 0.0, 1.5], [0.0, 30.0, 1.5], [0.0, 1.0, 1.5]])
    assert seen_from(behind, FLAT, straight, [camera()], 3.0) == pytest.approx([20.06, 30.0, 3.0], rel=0.01)
    assert seen_from(behind, FLAT, straight, [camera()], 0.5)[2] == pytest.approx(math.hypot(1.0, 1.5))


def test_a_turn_on_the_spot_is_looked_at_all_around():
    """A long lens, which is asked for no place here, makes all that the other one shows as coarse as from far away."""
    spun = Trajectory(100_000 * torch.arange(73), torch.stack([yaw(math.radians(5 * i)) for i in range(73)]))
    rig = [camera(), camera(0.0, 4.0)]
    angles = np.radians(np.arange(-177.5, 180, 15))
    around = np.column_stack([10 * np.cos(angles), 10 * np.sin(angles), np.full(len(angles), HIGH)])
    times = rig[1].lens.focal()[0] / rig[0].lens.focal()[0]
    assert seen_from(around, FLAT, spun, rig, 3.0) == pytest.approx(10 * times, rel=0.1)
    once = seen_from(around, FLAT, spun.within((0, 100_000)), rig, 3.0)
    ahead = np.abs(np.degrees(angles)) < 20
    assert once[ahead] == pytest.approx(10 * times, rel=0.1) and once[~ahead] == pytest.approx(10.1, rel=0.02)
