"""Surfaces past the pictures' borders, where lidar knows them and cameras beside the path would see them."""

from pathlib import Path

import numpy as np
import torch

from recon.log import Log, LogCamera
from recon.seeds.aside import FARTHEST, seen_from_aside
from recon.seeds.points import Cloud
from recon.views.frames import Frames
from recon.views.view import View
from scenes.ground import Ground
from scenes.lenses import Pinhole
from scenes.trajectory import Trajectory

RED, GREY = [0.8, 0.1, 0.1], [0.4, 0.4, 0.4]


def ahead() -> tuple[Log, Frames]:
    """A camera 1.5 m above the ground that looks along x, 90 degrees wide, from five places 1 m apart."""
    times = 100_000 * torch.arange(5)
    body = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    body[:, 0, 3] = torch.arange(5)
    mount = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]], dtype=torch.float64)
    camera = LogCamera("front", Pinhole(48.0, 48.0, 48.0, 27.0), 96, 54, (), times, body @ mount)
    log = Log("street", Path(), {"front": camera}, (), (), Trajectory(times, body), {})
    views = [View(0, i, int(t), torch.zeros(54, 96, 3), False, torch.zeros(1, 1)) for i, t in enumerate(times)]
    return log, Frames(["front"], [(96, 54)], views)


def found(*points: list[float], part: float = 1.0) -> np.ndarray:
    log, frames = ahead()
    level = Ground(torch.zeros(2, 2), (-50.0, -50.0), 100.0)
    known = Cloud(np.array([[6.0, 5.9, 1.5]] * 9 + [[9.0, -8.9, 1.5]] * 9), np.array([RED] * 9 + [GREY] * 9))
    cloud = seen_from_aside(log, frames, np.array(points), known, level, part)
    return np.column_stack([cloud.xyz, cloud.rgb])


def test_a_wall_past_the_border_is_taken_in_the_colours_beside_it():
    left, right = [5.0, 6.0, 1.5], [5.0, -7.0, 1.5]  # 5 m ahead of where the drive begins, out of its 45 degrees by 1 and 2 m
    got = found(left, right)
    np.testing.assert_allclose(got[:, :3], [left, right])
    np.testing.assert_allclose(got[:, 3:], [RED, GREY])


def test_a_car_takes_no_colour_of_the_road_beside_it():
    """The road is nearer to its sill than what pictures show of it."""
    log, frames = ahead()
    level = Ground(torch.zeros(2, 2), (-50.0, -50.0), 100.0)
    known = Cloud(np.array([[5.0, 5.9, 0.02]] * 9 + [[7.0, 6.0, 0.8]] * 9), np.array([GREY] * 9 + [RED] * 9))
    cloud = seen_from_aside(log, frames, np.array([[5.0, 6.2, 0.4]]), known, level)
    np.testing.assert_allclose(cloud.rgb, [RED])
    road = Cloud(known.xyz[:9], known.rgb[:9])
    np.testing.assert_allclose(seen_from_aside(log, frames, np.array([[5.0, 6.2, 0.4]]), road, level).rgb, [GREY])


def test_cameras_are_moved_aside_not_ahead():
    left, right = [38.0, 40.0, 1.5], [38.0, -40.0, 1.5]  # in view from 3 m aside of the first; 3 m behind it they are too far off
    assert len(found(left, right)) == 2


def test_what_pictures_show_and_what_no_view_from_aside_sees_is_left_to_others():
    shown, behind, beside = [6.0, 2.0, 1.5], [-5.0, 0.0, 1.5], [4.0, 12.0, 1.5]
    road, far, parked = [5.0, 6.0, 0.1], [FARTHEST + 6, FARTHEST + 8, 1.5], [2.0, 3.0, 1.0]
    assert len(found(shown, behind, beside, road, far, parked)) == 0


def test_a_cell_gives_one_point():
    assert len(found([5.01, 6.01, 1.51], [5.02, 6.02, 1.52], [5.03, 6.03, 1.53], [5.01, 6.31, 1.53])) == 2


def test_in_a_room_cameras_go_less_far_aside_and_nearer_things_count():
    beyond, near = [5.0, 6.0, 1.5], [2.0, 2.2, 1.0]  # in view from 1 m aside, and from 0.2 m
    np.testing.assert_allclose(found(beyond, near)[:, :3], [beyond])
    np.testing.assert_allclose(found(beyond, near, part=0.1)[:, :3], [near])
