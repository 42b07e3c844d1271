"""What crosses a painted street before a car that waits, which pictures alone show, and the boxes that are made of it."""

import numpy as np
import pytest
import torch
from painted import BOARD, SIZE, drive

from recon.movers.crossed import LONGEST_US, PERSON, believed, boxed
from recon.movers.crossing import _Found, _joined, _on_its_foot, crossings
from recon.movers.sighting import DISTANCES, Sighting
from recon.movers.traffic import traffic
from recon.seeds import stereo
from recon.views.frames import load_frames
from scenes.ground import Ground
from scenes.poses import CAM_FROM_FLU, translation

FLAT = Ground(torch.zeros(300, 300), (-50.0, -75.0), 0.5)
WAITS = [0.0] + [0.6] * 4 + [0.0] * 13
STEP_US = 100_000

pytestmark = pytest.mark.usefixtures("small_pictures")


def found(*rears):
    log = drive(WAITS, ("front",), rears=rears)
    return traffic(log, load_frames(log, ["front"], (0, 10**18), SIZE, 8), FLAT)


def test_what_crosses_before_a_car_that_waits_is_found_where_it_is():
    def board(seconds):
        return 12.0, 4.5 - 5.0 * seconds

    (track,) = found(board)
    middles = track.world_from_box[:, :2, 3].numpy()
    true = np.array([board(t / 1e6) for t in track.times_us]) + [0.0, BOARD / 2]
    seen = (track.times_us > 500_000) & (track.times_us < 1_500_000)
    assert seen.sum() > 5
    assert np.abs(middles[seen, 1] - true[seen, 1]).max() < 0.6
    assert abs(np.median(middles[seen, 0] - true[seen, 0])) < 1.2  # a step of the distances that are asked is one of them
    assert float(track.world_from_box[len(seen) // 2, 1, 0]) < -0.9  # it faces where it goes


def test_nothing_crosses_where_boards_stand():
    assert found(*(lambda seconds, x=x, y=y: (x, y) for x in (9.0, 13.0) for y in (-4.5, 2.9))) == ()


def crossing(time_us: int, y: float, wide: float, speed: float, x: float = 15.0, limit: float = np.inf) -> Sighting:
    """What is seen from the origin of what is so wide, its middle at y to the left, where no more is in view than to `limit` either way."""
    left, right = (float(np.clip(y + side * wide / 2, -limit, limit)) for side in (1, -1))
    place = np.array([x, (left + right) / 2])
    along = place / np.linalg.norm(place)
    velocity = np.array([0.0, speed])
    told = float(along @ velocity), float([-along[1], along[0]] @ velocity), 0.5, 0.4
    cuts = y + wide / 2 > limit, y - wide / 2 < -limit
    ends = np.array([[x, left], [x, right]])
    return Sighting(time_us, place, along, float(np.linalg.norm(place)), *told, any(cuts), ends=ends, cuts=cuts)


def tracked(things, count=40):
    cam_from_world = (CAM_FROM_FLU @ translation(z=-1.5)).numpy()
    plate = stereo.Plate(torch.zeros(90, 160), (160.0, 160.0), (80.0, 45.0), cam_from_world, torch.zeros(90, 160, 2), np.ones((90, 160)))
    return boxed(things, STEP_US * np.arange(count), [plate] * count, FLAT)


def test_a_car_that_crosses_is_as_long_as_it_looks_and_stands_behind_its_near_side():
    seen = [crossing(STEP_US * k, -9 + 0.9 * k, 4.6, 9.0, limit=7.0) for k in range(5, 17)]
    track = tracked(seen)
    assert track.label == "car" and track.size[0] == pytest.approx(4.6, abs=0.1)
    times = track.times_us / 1e6
    inside = (times > 0.5) & (times < 1.6)
    middles = track.world_from_box[:, :2, 3].numpy()
    assert np.abs(middles[inside] - np.stack([0 * times + 15.0 + track.size[1] / 2, -9 + 9 * times], 1)[inside]).max() < 0.5
    assert float(track.world_from_box[len(times) // 2, 1, 0]) > 0.99
    assert track.times_us[0] >= 500_000 - LONGEST_US and track.times_us[-1] <= 1_600_000 + LONGEST_US


def test_who_is_narrow_is_a_person():
    track = tracked([crossing(STEP_US * k, -3 + 0.14 * k, 0.5, 1.4, x=8.0) for k in range(20)])
    assert track.label == "pedestrian" and track.size.tolist() == list(PERSON)


def test_what_does_not_go_where_it_seems_to_is_not_believed():
    times = STEP_US * np.arange(20)
    going = [crossing(int(t), -5 + 6 * t / 1e6, 1.5, 6.0) for t in times]
    assert believed(going, times)
    assert not believed([crossing(int(t), -5.0, 1.5, 6.0) for t in times], times)
    assert not believed([crossing(int(t), -5 - 6 * t / 1e6, 1.5, 6.0) for t in times], times)
    assert not believed(going[::3], times)
    assert not believed(going[:5], times)


def test_parts_of_one_thing_are_one_and_those_of_two_are_two():
    wheels = [crossing(0, y, 1.0, 9.0) for y in (1.0, -0.6)]
    (one,) = _joined(wheels, np.zeros(2))
    assert one.ends is not None and np.abs(one.ends[:, 1] - [1.5, -1.1]).max() < 0.05
    assert len(_joined([wheels[0], crossing(0, -3.0, 1.0, 9.0)], np.zeros(2))) == 2  # far beside it
    assert len(_joined([wheels[0], crossing(0, -0.6, 1.0, 1.4)], np.zeros(2))) == 2  # slower
    assert len(_joined([wheels[0], crossing(0, -0.3, 0.5, 9.0, x=9.0)], np.zeros(2))) == 2  # nearer


def test_legs_that_swing_tell_how_near_somebody_is():
    bases = 45 + 160 * 1.5 / DISTANCES
    stands = np.full((90, 160), 0.2)
    stands[40:75, 70:80] = 0.8  # of a person who stands 8 m away, at row 75
    trunk = _Found(75, slice(40, 57), 20.0, 3.0, 0.5, 0.3, np.zeros(160))
    nearer = _on_its_foot(trunk, slice(70, 80), stands, bases)
    assert nearer.away == pytest.approx(8.0, rel=0.15) and nearer.speed == pytest.approx(3.0 * nearer.away / 20)
    stands[57:75] = 0.2
    assert _on_its_foot(trunk, slice(70, 80), stands, bases) == trunk


def test_a_camera_that_looks_down_sees_nothing_cross():
    down = np.diag([1.0, -1.0, -1.0, 1.0]) @ translation(z=-5.0).numpy()
    grey = torch.rand(48, 64, generator=torch.Generator().manual_seed(0)) * 255 - 128
    plate = stereo.Plate(grey, (60.0, 60.0), (32.0, 24.0), down, torch.zeros(48, 64, 2), np.ones((48, 64)))
    later = stereo.Plate(grey.roll(6, 1), (60.0, 60.0), (32.0, 24.0), down, torch.zeros(48, 64, 2), np.ones((48, 64)))
    assert crossings(plate, 0, [[(later, 200_000)]], FLAT) == []
