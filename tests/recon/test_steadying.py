"""Boxes of moving things laid where lidar's points in them meet (recon/movers/steadying.py)."""

import numpy as np
import pytest
import torch
from followed_car import COUNT, STAMPS, boxed, drive, shaken, way

from recon.log import Track
from recon.movers.steadying import steadied
from recon.objects.tracks import upright
from scenes.poses import inverse, yaw_of


def unrest(track: Track, truth: torch.Tensor) -> tuple[float, float]:
    """By how many metres and degrees, root mean square, poses are off from others `[T, 4, 4]`, but for what is so in all: points may
    lie anywhere in a box as long as they do not move."""
    off = inverse(truth) @ track.world_from_box
    places, turns = off[:, :3, 3], yaw_of(off)
    return float((places - places.mean(0)).norm(dim=1).square().mean().sqrt()), float(torch.rad2deg((turns - turns.mean()).std()))


def test_boxes_drawn_anew_each_time_lie_where_their_points_meet():
    drawn = boxed(STAMPS, shaken(way(STAMPS)))
    (found,) = steadied(log := drive(drawn), log.sweeps).tracks
    assert unrest(drawn, way(STAMPS))[0] > 0.15 and unrest(drawn, way(STAMPS))[1] > 1.5
    metres, degrees = unrest(found, way(STAMPS))
    assert metres < 0.03 and degrees < 0.3
    assert (found.name, found.label, found.sources) == ("veh_1", "car", ("a",)) and found.times_us.tolist() == STAMPS.tolist()
    mean = (inverse(way(STAMPS)) @ found.world_from_box)[:, :3, 3].mean(0)
    assert mean.norm() < 0.1, "all boxes together say where they lie about what they hold"


def test_without_points_boxes_go_on_as_something_heavy_does():
    drawn = boxed(STAMPS, shaken(way(STAMPS)))
    log = drive(drawn, late_us=lambda k: {})
    (found,) = steadied(log, log.sweeps).tracks
    assert unrest(found, way(STAMPS))[0] < 0.6 * unrest(drawn, way(STAMPS))[0]


def test_between_boxes_of_every_half_second_it_brakes_where_it_was_seen_to():
    few = STAMPS[::5].copy()
    log = drive(boxed(few, way(few, brakes=6.0)), brakes=6.0)
    (found,) = steadied(log, log.sweeps).tracks
    there = STAMPS[: 5 * len(few) - 2]  # and half a step beyond its last box
    assert found.times_us.tolist() == there.tolist()
    between = boxed(there, log.tracks[0].trajectory().near_each(torch.from_numpy(there)))
    assert unrest(between, way(there, brakes=6.0))[0] > 0.07
    assert unrest(found, way(there, brakes=6.0))[0] < 0.03


@pytest.mark.parametrize("matched", [True, False], ids=["boxes of sweeps", "boxes of moments of their own"])
def test_points_are_as_late_as_the_lidar_passes(matched):
    """Boxes of a sweep are drawn around its points, wherever the car is at its stamp; others are where it is then."""
    times = STAMPS if matched else STAMPS[2:-2] + 30_000
    drawn = way(times - 150_000 * matched)
    log = drive(boxed(times[::5].copy(), shaken(drawn[::5], 0.05, 0.01)), late_us=lambda k: {0: -150_000})
    (found,) = steadied(log, log.sweeps).tracks
    assert len(found.times_us) > 20
    assert unrest(found, way(found.times_us - 150_000 * matched))[0] < 0.03


def test_a_second_lidar_that_passes_later_makes_no_car_jump():
    """Its boxes are drawn where the car is by then, 0.4 m on: they are not off."""
    sensor = np.arange(COUNT) % 2
    drawn = boxed(STAMPS, way(STAMPS + 50_000 * sensor), sensor)
    log = drive(drawn, late_us=lambda k: {0: 0, 1: 50_000})
    assert steadied(log, log.sweeps).tracks[0] is drawn


def test_two_lidars_that_pass_at_moments_of_their_own_show_one_car():
    """Half of the points were taken 50 ms later, 0.4 m on; nobody says for which lidar boxes are drawn."""
    drawn = boxed(STAMPS, shaken(way(STAMPS)), sensor=-1)
    log = drive(drawn, late_us=lambda k: {0: -25_000, 1: 25_000})
    (found,) = steadied(log, log.sweeps).tracks
    assert unrest(found, way(STAMPS))[0] < 0.03


def test_what_a_turn_of_the_lidar_begins_and_ends_with_is_seen_twice():
    """Points of its rear were taken 0.1 s before some of its front, in every third sweep."""
    drawn = boxed(STAMPS, shaken(way(STAMPS)))
    log = drive(drawn, late_us=lambda k: {0: [0, 0, 100_000] if k % 3 == 0 else 0})
    (found,) = steadied(log, log.sweeps).tracks
    assert unrest(found, way(STAMPS))[0] < 0.03


def test_a_box_that_is_alone_in_being_off_pulls_no_other():
    poses = way(STAMPS).clone()
    poses[12, :2, 3] += torch.tensor([0.3, 0.25])
    log = drive(boxed(STAMPS, poses))
    (found,) = steadied(log, log.sweeps).tracks
    assert unrest(found, way(STAMPS))[0] < 0.02


def test_what_is_between_the_boxes_of_another_lean_as_these():
    leant = way(STAMPS) @ upright(np.zeros((1, 3)), np.zeros(1))
    tilt = torch.eye(4, dtype=torch.float64)
    tilt[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0, 0, 0.1], [0, 0, 0], [-0.1, 0, 0]], dtype=torch.float64))
    log = drive(boxed(STAMPS, shaken(leant) @ tilt))
    (found,) = steadied(log, log.sweeps).tracks
    up = found.world_from_box[:, 2, 2]
    assert not found.world_from_box.equal(log.tracks[0].world_from_box)
    torch.testing.assert_close(up, torch.full_like(up, np.cos(0.1)))


@pytest.mark.parametrize("what", ["exact", "a pedestrian", "standing", "no sweeps"])
def test_what_needs_nothing_is_as_it_was(what):
    poses = way(STAMPS) if what == "exact" else shaken(way(STAMPS))
    track = boxed(STAMPS, poses, label="pedestrian" if what == "a pedestrian" else "car")
    if what == "standing":
        track = Track(**{**track.__dict__, "moving": False})
    log = drive(track)
    assert steadied(log, () if what == "no sweeps" else log.sweeps).tracks[0] is track
