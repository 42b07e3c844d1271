import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from randomized import START_US, poses, trajectory

from scenes import Trajectory
from scenes.poses import interpolate, translation, yaw


def left_turn(radius=20.0, count=40):
    """A body that drives a left turn of `radius` around the origin, nose along its way."""
    angles = torch.linspace(0, math.pi, count, dtype=torch.float64)
    return Trajectory(START_US + 100_000 * torch.arange(count), torch.stack([yaw(float(a)) @ translation(0, -radius) for a in angles]))


@pytest.mark.parametrize("lateral", [2.0, -3.0])
def test_a_shift_and_its_reverse_return_within_a_millimetre(lateral):
    for path in (left_turn(), trajectory()):
        back = path.shifted(lateral=lateral).shifted(lateral=-lateral)
        assert (back.world_from_body - path.world_from_body).abs().max() < 1e-3


@given(st.floats(-15, 15))
def test_on_a_left_turn_a_shift_to_the_left_shortens_the_radius(lateral):
    places = left_turn(20.0).shifted(lateral=lateral).world_from_body[:, :2, 3]
    assert torch.allclose(places.norm(dim=1), torch.tensor(20.0 - lateral, dtype=torch.float64), atol=1e-9)


def test_shifts_are_along_the_bodys_own_axes():
    path = trajectory()
    moved = path.shifted(lateral=2.0, vertical=3.0, forward=1.0)
    steps = torch.linalg.inv(path.world_from_body) @ moved.world_from_body
    assert torch.allclose(steps, translation(1.0, 2.0, 3.0).expand_as(steps), atol=1e-12)
    assert torch.equal(moved.times_us, path.times_us)


def test_shifting_and_taking_a_time_commute_on_a_straight_drive():
    straight = Trajectory(START_US + 100_000 * torch.arange(5), torch.stack([translation(float(i)) for i in range(5)]))
    time = START_US + 123_456
    assert torch.allclose(straight.shifted(lateral=2).at(time), straight.at(time) @ translation(0, 2), atol=1e-12)


def test_the_poses_stand_at_their_times_and_between_by_interpolation():
    path = trajectory()
    for i, time in enumerate(path.times_us.tolist()):
        assert torch.allclose(path.at(time), path.world_from_body[i], atol=1e-12)
    between = path.at(START_US + 100_003 + 25_000)
    assert torch.allclose(between, interpolate(path.world_from_body[1], path.world_from_body[2], 25_000 / 100_003), atol=1e-12)


def test_half_a_step_beyond_either_end_is_covered_and_more_is_not():
    path = left_turn()
    first, last = path.span_us()
    assert (first, last) == (START_US - 50_000, int(path.times_us[-1]) + 50_000)
    for time in (first, last):
        assert path.covers(time) and torch.isfinite(path.at(time)).all()
    for time in (first - 1, last + 1):
        assert not path.covers(time)
        with pytest.raises(ValueError, match=f"time {time} us is outside the trajectory, which covers {first} to {last} us"):
            path.at(time)


def test_one_pose_stands_still_for_ever():
    still = Trajectory(torch.tensor([5]), poses(1))
    for time in (-(2**62), 0, 2**62):
        assert torch.equal(still.at(time), still.world_from_body[0])


@pytest.mark.parametrize(
    "times, count, said",
    [
        ([], 0, "at least one pose"),
        ([1, 1], 2, "rise strictly, but entry 1 does not"),
        ([1, 3, 2], 3, "rise strictly, but entry 2 does not"),
        ([1, 2], 3, r"world_from_body must have shape \(2, 4, 4\), got \(3, 4, 4\)"),
    ],
)
def test_impossible_trajectories_are_refused(times, count, said):
    with pytest.raises(ValueError, match=said):
        Trajectory(torch.tensor(times, dtype=torch.int64), poses(count))


def test_times_that_are_no_whole_microseconds_are_refused_and_not_cut():
    with pytest.raises(ValueError, match="times_us must be whole microseconds, got 0.6; seconds times 1e6"):
        Trajectory([0.0, 0.6], poses(2))
    path = Trajectory([0.0, 1.7e15 + 1], poses(2))
    assert path.times_us.tolist() == [0, 1_700_000_000_000_001]
    with pytest.raises(ValueError, match="a time must be whole microseconds, got 50.7"):
        path.at(50.7)
    assert torch.equal(path.at(50.0), path.at(50))


@pytest.mark.parametrize(
    ("span", "kept"), [((150, 250), [100, 200, 300]), ((100, 300), [100, 200, 300]), ((-50, 50), [0, 100]), ((350, 900), [300, 400])]
)
def test_a_part_of_a_path_has_its_poses_and_one_on_either_side(span, kept):
    """So that it is as the whole path is at all moments of the span."""
    path = Trajectory(torch.arange(5) * 100, torch.stack([translation(float(x), 0) for x in range(5)]))
    part = path.within(span)
    assert part.times_us.tolist() == kept
    inside = torch.arange(max(span[0], 0), min(span[1], 400), 30)
    assert torch.equal(part.at_each(inside), path.at_each(inside))
