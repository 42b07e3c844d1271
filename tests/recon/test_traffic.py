"""Painted cars that go along a painted street, which pictures alone show."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from painted import BOARD, SIZE, Rear, drive

from recon.log import Track
from recon.movers.boxing import CAR, smoothed
from recon.movers.going import BEYOND_US
from recon.movers.sighting import ALIKE, Sighting, along_itself, facing_us, hiding, nearest_of_each, outline
from recon.movers.traffic import ENOUGH, around, believed, boxes, spaced, traffic
from recon.seeds import stereo
from recon.views.frames import load_frames
from scenes.ground import Ground
from scenes.lane import Lane
from scenes.poses import CAM_FROM_FLU, translation
from scenes.trajectory import Trajectory

FLAT = Ground(torch.zeros(300, 300), (-50.0, -75.0), 0.5)
STEPS = [0.0] + [0.6] * 15

pytestmark = pytest.mark.usefixtures("small_pictures")


def found(*rears: Rear, steps=STEPS, **how) -> tuple[Track, ...]:
    log = drive(steps, ("front",), rears=rears, **how)
    return traffic(log, load_frames(log, ["front"], (0, 10**18), SIZE, 8), FLAT)


def misses(track: Track, rear: Rear, behind: float) -> np.ndarray:
    """Metres `[T, 2]` along and across that a box's middle is off, where it is `behind` the board; seen from the first camera."""
    places = np.array([rear(t / 1e6) for t in track.times_us]) + [behind, BOARD / 2]
    return track.world_from_box[:, :2, 3].numpy() - places


@pytest.mark.parametrize(
    ("start", "speed", "left"), [(9.0, 7.5, -0.5), (24.0, -6.0, 1.6), (6.0, 11.0, 1.8)], ids=["ahead", "oncoming", "passing"]
)
def test_what_goes_along_the_street_is_found_where_it_is(start, speed, left):
    def rear(seconds):
        return start + speed * seconds, left + seconds * speed / 12

    (track,) = found(rear)
    off = misses(track, rear, CAR[0] / 2)
    path = track.trajectory()
    went = (path.at(1_000_000)[:2, 3] - path.at(500_000)[:2, 3]).numpy() / 0.5
    assert track.moving and track.label == "car" and len(track.times_us) > 8
    # the painted street is as rich as the cars: what stands on it seems a tenth too far, at most
    assert np.median(np.abs(off[:, 0])) < 2.5 and np.median(np.abs(off[:, 1])) < 0.7
    assert abs(went[0] - speed) < 2.0
    assert float(track.world_from_box[0, 0, 0]) * speed > 0


@pytest.mark.parametrize(("start", "speed", "left"), [(9.0, 7.5, -0.5), (24.0, -6.0, 1.6)], ids=["ahead", "oncoming"])
def test_what_goes_up_or_down_a_steep_street_is_found(start, speed, left):
    """From picture to picture it climbs by a part of its own height."""
    climb = math.radians(8)
    turn = torch.eye(4, dtype=torch.float64)
    turn[0, 0] = turn[2, 2] = math.cos(climb)
    turn[2, 0], turn[0, 2] = math.sin(climb), -math.sin(climb)
    log = drive(STEPS, ("front",), rears=(lambda seconds: (start + speed * seconds, left + seconds * speed / 12),))
    cameras = {name: replace(camera, world_from_cam=turn @ camera.world_from_cam) for name, camera in log.cameras.items()}
    log = replace(log, ego=replace(log.ego, world_from_body=turn @ log.ego.world_from_body), cameras=cameras)
    heights = math.tan(climb) * (FLAT.origin[0] + FLAT.cell * torch.arange(300)).expand(300, 300).contiguous()
    (track,) = traffic(log, load_frames(log, ["front"], (0, 10**18), SIZE, 8), replace(FLAT, heights=heights))
    places = np.array([start + speed * t / 1e6 + CAR[0] / 2 for t in track.times_us]) * math.cos(climb)
    middles = track.world_from_box[:, :3, 3].numpy()
    assert len(track.times_us) > 8 and np.median(np.abs(middles[:, 0] - places)) < 2.5
    assert np.abs(middles[:, 2] - math.tan(climb) * middles[:, 0]).max() < 0.1


def test_what_drifts_towards_us_comes_as_fast_as_it_is():
    """Far aside, it looks like something slower that keeps its distance from our way."""

    def front(seconds):
        return 27 - 9 * seconds, 5.0 - 0.75 * seconds + seconds / 2

    (track,) = found(front)
    path = track.trajectory()
    went = (path.at(1_000_000)[:2, 3] - path.at(400_000)[:2, 3]).numpy() / 0.6
    assert abs(went[0] + 9) < 1.0
    # a board has no flank, which is taken for the half of it that is farther from us
    assert np.median(np.abs(misses(track, front, CAR[0] / 2)[:, 1])) < CAR[1] / 2


def test_a_car_is_where_its_outline_says_whatever_of_it_is_seen():
    length, wide = CAR[0], CAR[1] / 2
    for ahead, left in ((20.0, 8.0), (12.0, 3.5), (8.0, -3.5), (30.0, -6.0), (15.0, 0.5)):
        slopes = [y / x for x in (ahead, ahead + length) for y in (left - wide, left + wide)]
        facing, flank = np.array([ahead, left]), np.array([ahead + 2, np.copysign(abs(left) - wide, left)])
        for seen in (facing, flank) if abs(left) > wide else (facing,):
            ends = [np.array([seen[0], seen[0] * slope]) for slope in (min(slopes), max(slopes))]
            assert np.abs(facing_us(seen, *ends) - facing).max() < 0.2
        wider = [np.array([ahead, ahead * left / ahead + off]) for off in (-4.0, 4.0)]
        assert facing_us(facing, *wider).tolist() == facing.tolist()


def test_an_outline_ends_where_things_look_half_as_much_more_alike():
    worths = np.zeros(80)
    worths[30:50] = 0.4
    assert np.abs(np.subtract(outline(worths, slice(30, 41)), (30, 49))).max() <= 1
    assert np.abs(np.subtract(outline(worths, slice(44, 58)), (30, 49))).max() <= 1
    assert outline(np.ones(80), slice(30, 41)) == (0, 79)


def test_what_hides_a_foot_stands_nearer_than_what_stands_on_it():
    standing = torch.ones(4, 3, 40)
    standing[1, :, 10:20], standing[2, :, 25:35] = 0.2, 0.1
    costs = hiding(standing, torch.tensor([3.0, 2.0, 1.1, 0.5]), 5)
    assert costs[14] == pytest.approx(0.2) and costs[29] == pytest.approx(1.0)
    assert np.isinf(hiding(standing, torch.zeros(4), 5)).all()


def test_nothing_is_found_where_nothing_moves():
    """Though boards stand at the street's sides, and hide one another."""
    assert found(*(lambda seconds, x=x, y=y: (x, y) for x in (8.0, 13.0, 18.0, 25.0) for y in (-4.5, 2.9))) == ()


def test_pictures_that_follow_one_another_late_and_a_car_that_never_goes_tell_nothing():
    assert found(lambda seconds: (9 + 7.5 * seconds, -0.5), step_us=500_000) == ()
    assert found(lambda seconds: (9 + 7.5 * seconds, -0.5), steps=[0.0] * 9) == ()


def test_of_a_fast_video_every_few_pictures_are_looked_at():
    class At:
        def __init__(self, time_us):
            self.time_us = time_us

    times = [view.time_us for view in spaced([At(33_333 * k) for k in range(31)])]
    assert np.diff(times).min() >= 80_000 and np.diff(times).max() <= 100_000 and times[0] == 0
    assert [view.time_us for view in spaced([At(100_000 * k) for k in range(5)])] == [0, 100_000, 200_000, 300_000, 400_000]
    assert spaced([]) == []


def sighted(time_us: int, x: float, speed: float, y: float = 0.0, cut: bool = False) -> Sighting:
    return Sighting(time_us, np.array([x, y]), np.array([1.0, 0.0]), x, speed, 0.0, 0.3, 0.2, cut)


def plate_showing(grey: torch.Tensor) -> stereo.Plate:
    """Grey levels `[90, 160]`, 53 degrees wide, 1.5 metres above the ground, looking along x."""
    cam_from_world = (CAM_FROM_FLU @ translation(z=-1.5)).numpy()
    return stereo.Plate(grey, (160.0, 160.0), (80.0, 45.0), cam_from_world, torch.zeros(90, 160, 2), np.ones((90, 160)))


def tracked_all(seen: Sequence[list[Sighting]]) -> list[Track]:
    """The boxes of what pictures show that a camera takes on the spot 0.1 seconds apart, 53 degrees wide, 1.5 metres above a straight
    street."""
    plate = plate_showing(torch.zeros(90, 160))
    lane = Lane(Trajectory(torch.tensor([0, 10**6]), torch.stack([translation(), translation(x=10.0)])))
    return boxes(list(seen), np.arange(len(seen)) * 100_000, [plate] * len(seen), lane, FLAT)


def tracked(seen: list[Sighting], count: int) -> Track:
    """The box of one thing, in `count` pictures."""
    by_time = {s.time_us: [s] for s in seen}
    (track,) = tracked_all([by_time.get(100_000 * k, []) for k in range(count)])
    return track


def test_what_does_not_go_where_it_seems_to_is_not_believed():
    times = np.arange(12) * 100_000
    assert believed([sighted(t, 12 + 6 * t / 1e6, 6.0) for t in times], times)
    assert not believed([sighted(t, 12.0, 6.0) for t in times], times)
    assert not believed([sighted(t, 12 - 6 * t / 1e6, 6.0) for t in times], times)
    assert not believed([sighted(t, 12 + 6 * t / 1e6, 6.0) for t in times[::2]], times)  # half of the pictures do not show it


def test_what_comes_aslant_is_not_believed():
    times = np.arange(12) * 100_000
    slow, fast = [sighted(t, 30 - 8 * t / 1e6, -8.0) for t in times], [sighted(t, 12 + 25 * t / 1e6, 25.0) for t in times]
    assert not believed([replace(s, aside=-0.8) for s in slow], times) and not believed([replace(s, aside=0.8) for s in slow], times)
    assert believed([replace(s, aside=0.4) for s in slow], times) and believed([replace(s, aside=1.2) for s in fast], times)


def test_a_rail_along_the_street_looks_like_itself_and_a_car_does_not():
    """What a rail shows depends on the direction from the vanishing point alone."""
    blotches = 60 * torch.randn(90, 160, generator=torch.Generator().manual_seed(3))
    y, x = torch.meshgrid(torch.arange(90) - 44.5, torch.arange(160) - 79.5, indexing="ij")
    rail = 60 * torch.sin(25 * torch.atan2(y, x))
    beside, rows, columns = sighted(0, 12.0, 6.0), slice(50, 66), slice(115, 135)
    assert along_itself(plate_showing(rail), beside, 125, rows, columns).mean() < 0.1
    assert along_itself(plate_showing(blotches), beside, 125, rows, columns).mean() > 0.8
    assert np.isinf(along_itself(plate_showing(rail), beside, 80, rows, slice(70, 90))).all()


def test_what_is_behind_the_end_of_a_car_is_its_flank():
    end, flank, next_one = (sighted(0, x, -6.0, y) for x, y in ((18.0, 3.0), (22.0, 2.4), (26.5, 3.0)))
    assert [s.away for s in nearest_of_each([flank, end, next_one])] == [18.0, 26.5], "a second car is farther off than the first is long"
    beside, faster = sighted(0, 22.0, -6.0, 6.0), replace(flank, speed=-6.0 - ALIKE - 0.1)
    assert len(nearest_of_each([end, beside])) == len(nearest_of_each([end, faster])) == 2
    assert len(nearest_of_each([replace(end, worth=0.1), flank])) == 2, "what is hardly seen hides nothing"
    assert len(nearest_of_each([end, replace(end, worth=0.2)])) == 1


def test_what_stands_looks_only_for_a_moment_as_if_it_moved():
    def seen(count: int, speed: float) -> bool:
        """Whether it is believed where so many pictures show it."""
        times = np.arange(count) * 100_000
        return believed([sighted(t, 40 + speed * t / 1e6, speed) for t in times], times)  # 0.5 more alike, with the ground

    along = int(10 * ENOUGH[0] / 0.5)
    assert seen(along + 1, 6.0) and not seen(along - 1, 6.0)
    coming = int(10 * ENOUGH[1] / 14 / 0.5) + 1
    assert coming < along - 1 and seen(max(coming, 6), -14.0) and not seen(max(coming, 6), 14.0)


def test_what_was_followed_in_pieces_has_one_box():
    """Nothing showed it for longer than it is followed."""
    times = range(0, 4_000_000, 100_000)
    (whole,) = tracked_all([[sighted(t, 20 + 5 * t / 1e6, 5.0)] for t in times])
    (track,) = tracked_all([[sighted(t, 20 + 5 * t / 1e6, 5.0)] if t // 100_000 not in (18, 19, 20, 21, 22, 23) else [] for t in times])
    assert track.times_us.tolist() == whole.times_us.tolist()
    assert np.abs(track.world_from_box[:, 0, 3].numpy() - whole.world_from_box[:, 0, 3].numpy()).max() < 0.2


@pytest.mark.parametrize("part", ["worth", "grounded"])
def test_what_looks_as_if_it_stood_or_were_no_thing_is_not_believed(part):
    times = np.arange(12) * 100_000
    assert not believed([replace(sighted(t, 12 + 6 * t / 1e6, 6.0), **{part: 0.05}) for t in times], times)


def test_a_car_that_passes_us_keeps_its_box_until_it_is_behind_us():
    track = tracked([sighted(t, 14 - 10 * t / 1e6, -10.0, 3.0) for t in range(0, 900_000, 100_000)], 30)
    middles = track.world_from_box[:, 0, 3].numpy()
    assert np.allclose(middles, 14 - 10 * track.times_us / 1e6 + CAR[0] / 2, atol=0.3)
    assert -CAR[0] / 2 - 0.1 < middles[-1] < -CAR[0] / 2 + 1.1


def test_a_car_that_overtakes_us_has_its_box_from_when_it_is_beside_us():
    track = tracked([sighted(t, 10 * t / 1e6 - 8, 10.0, 2.5) for t in range(2_000_000, 3_000_000, 100_000)], 32)
    middles = track.world_from_box[:, 0, 3].numpy()
    assert np.allclose(middles, 10 * track.times_us / 1e6 - 8 + CAR[0] / 2, atol=0.3)
    assert -CAR[0] / 2 - 0.1 < middles[0] < -CAR[0] / 2 + 1.1


def test_far_away_a_car_goes_on_for_a_moment_only():
    track = tracked([sighted(t, 20 + 5 * t / 1e6, 5.0) for t in range(1_500_000, 2_500_000, 100_000)], 50)
    assert track.times_us[[0, -1]].tolist() == [1_500_000 - BEYOND_US, 2_400_000 + BEYOND_US]


def test_where_the_border_cuts_a_car_it_keeps_to_its_lane():
    """What is left of it in the picture looks as if it came nearer to us sideways."""

    def seen(cut: bool) -> list[Sighting]:
        sides = {t: 3.5 - max(0.0, 0.8 - t / 1e6) for t in range(0, 2_000_000, 100_000)}
        return [sighted(t, 8 + 5 * t / 1e6, 5.0, side, cut and side < 3.5) for t, side in sides.items()]

    off = {cut: np.abs(tracked(seen(cut), 20).world_from_box[:, 1, 3].numpy() - 3.5).max() for cut in (False, True)}
    assert off[True] < 0.2 and off[False] > 2 * off[True]


def test_of_two_sightings_of_one_car_side_by_side_one_box_is_made():
    times = range(0, 2_000_000, 100_000)
    (track,) = tracked_all([[sighted(t, 20 + 5 * t / 1e6, 5.0, y) for y in (-0.9, 1.0)] for t in times])
    assert len(track.times_us) == 20


def test_a_picture_is_compared_with_those_soon_before_and_after_it():
    times = np.arange(10) * 100_000
    assert [[t for _, t in side] for side in around(4, [None] * 10, times)] == [[200_000, 0], [600_000, 900_000]]
    assert [[t for _, t in side] for side in around(0, [None] * 10, times)] == [[200_000, 500_000]]
    assert around(4, [None] * 10, 5 * times) == []


def test_a_way_keeps_to_the_lines_of_sight_where_distances_are_unsure():
    times = np.linspace(0, 2, 21)
    true = np.stack([20 + 5 * times, np.full(21, 4.0)], 1)
    out = true / np.linalg.norm(true, axis=1)[:, None]
    across = np.stack([-out[:, 1], out[:, 0]], 1)
    seen = true + out * np.where(np.arange(21) % 2, 2.0, -2.0)[:, None]
    told = out[:, :, None] * out[:, None] / 4 + across[:, :, None] * across[:, None] * 100
    assert np.abs(smoothed(times, seen, times, told) - true).max() < 0.7


def test_a_way_is_as_fast_as_it_is_told_where_places_are_unsure():
    times = np.linspace(0, 1, 11)
    true = np.stack([20 + 5 * times, np.full(11, 4.0)], 1)
    seen, told = true + np.stack([2 * times - 1, 0 * times], 1), np.broadcast_to(np.eye(2) / 4, (11, 2, 2))
    speeds = np.tile([5.0, 0.0], (11, 1)), np.array([0.3, 0.3])
    assert np.abs(smoothed(times, seen, times, told, speeds) - true).max() < 0.1
    assert np.abs(smoothed(times, seen, times, told) - true).max() > 0.8
