"""Boards that go along a painted street like cars' rears, which pictures alone show."""

import numpy as np
import painted
import pytest
import torch
from painted import BOARD, SIZE, Rear, drive

from recon.log import Track
from recon.movers.boxing import CAR, smoothed
from recon.movers.sighting import Sighting
from recon.movers.traffic import around, believed, boxes, spaced, traffic
from recon.seeds import stereo
from recon.views.frames import load_frames
from scenes.ground import Ground

FLAT = Ground(torch.zeros(300, 300), (-50.0, -75.0), 0.5)
STEPS = [0.0] + [0.6] * 15


@pytest.fixture(scope="module", autouse=True)
def small_pictures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stereo, "WIDTH", 160)
        patch.setattr(painted, "WALL", 60.0)
        yield


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
    assert np.median(np.abs(off[:, 0])) < 2.0 and np.median(np.abs(off[:, 1])) < 0.5
    assert abs(went[0] - speed) < 2.0
    assert float(track.world_from_box[0, 0, 0]) * speed > 0


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


def sighted(time_us: int, x: float, speed: float, y: float = 0.0) -> Sighting:
    return Sighting(time_us, np.array([x, y]), np.array([1.0, 0.0]), x, speed, 0.3, 0.2)


def test_what_does_not_go_where_it_seems_to_is_not_believed():
    times = np.arange(12) * 100_000
    assert believed([sighted(t, 12 + 6 * t / 1e6, 6.0) for t in times], times)
    assert not believed([sighted(t, 12.0, 6.0) for t in times], times)
    assert not believed([sighted(t, 12 - 6 * t / 1e6, 6.0) for t in times], times)
    assert not believed([sighted(t, 12 + 6 * t / 1e6, 6.0) for t in times[::2]], times)  # half of the pictures do not show it


def test_a_car_that_passes_us_keeps_its_box_beyond_what_was_seen_of_it():
    times, eyes = np.arange(14) * 100_000, np.zeros((14, 2))
    (track,) = boxes([[sighted(t, 14 - 10 * t / 1e6, -10.0, 3.0)] if t < 900_000 else [] for t in times], times, eyes, FLAT)
    middles = track.world_from_box[:, 0, 3].numpy()
    assert track.times_us[-1] == 1_300_000 and np.allclose(middles, 14 - 10 * track.times_us / 1e6 + CAR[0] / 2, atol=0.3)


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
