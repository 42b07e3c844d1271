from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.log import Track
from recon.objects.tracks import Boxes, _steady, facing, named, tracks_of, upright
from scenes.trajectory import Trajectory


def _track(yaws, step_us, label="car"):
    places = np.stack([np.arange(len(yaws)), 0 * np.array(yaws), 0 * np.array(yaws)], 1)
    times = np.arange(len(yaws)) * step_us
    return Track("", label, True, np.array([4.0, 2, 1.5]), times, upright(places, yaws), np.full(len(yaws), -1), ("a",))


@pytest.mark.parametrize("wrong", [[3], [0], [2, 3], [0, 4, 6]])
def test_a_box_that_was_drawn_backwards_faces_as_the_others_do(wrong):
    yaws = 0.1 * np.arange(7) + 0.4
    turned = yaws.copy()
    turned[wrong] += np.pi
    torch.testing.assert_close(facing(_track(turned, 100_000)).world_from_box, _track(yaws, 100_000).world_from_box)


EGO = Trajectory(torch.zeros(1, dtype=torch.int64), torch.eye(4, dtype=torch.float64)[None])


def test_nothing_goes_on_where_its_boxes_leave_a_gap():
    seen = _track([0.0] * 20, 100_000)
    broken = replace(seen, times_us=seen.times_us + 6_000_000 * (np.arange(20) >= 8))
    before, after = (t.trajectory().span_us() for t in named([broken], EGO))
    assert before == (-50_000, 750_000) and after == (6_750_000, 7_950_000)
    rare = _track([0.0] * 9, 1_000_000)  # a log that annotates every second
    occluded = replace(_track([0.0] * 9, 500_000), times_us=500_000 * np.delete(np.arange(10), 4))
    parked = replace(broken, moving=False)
    for whole in (rare, occluded, parked):
        assert [len(t.times_us) for t in named([whole], EGO)] == [len(whole.times_us)]


def test_what_moves_and_has_one_box_is_not_there_all_the_time():
    (track,) = named([_track([0.3], 1)], EGO)
    path = track.trajectory()
    assert path.span_us() == (-75_000, 75_000)
    torch.testing.assert_close(path.at(0), _track([0.3], 1).world_from_box[0])


def _boxes(x, z=0.0):
    places = np.stack([x, 0 * x, z + 0 * x], 1)
    return Boxes("a", "car", 100_000 * np.arange(len(x)), upright(places, 0 * x), np.tile([4.0, 2, 1.5], (len(x), 1)))


def test_one_box_astray_or_heights_that_drift_move_no_parked_car():
    parked, rising = np.full(60, 14.0), np.linspace(0, 2.4, 60)
    for astray in (0, 30, 59):
        off = parked + 1.2 * (np.arange(60) == astray)
        assert not tracks_of([_boxes(off, rising)], EGO, "here")[0].moving, astray
    leaving = parked + np.maximum(0, np.arange(60) - 56) ** 2 * 0.4
    for x in (leaving, 14 - leaving, np.arange(2) * 3.0, np.arange(3) * 1.5, np.arange(4) * 1.5):
        assert tracks_of([_boxes(x)], EGO, "here")[0].moving, x


def test_what_has_time_to_turn_round_may():
    there_and_back = np.array([0.0, 0, 0, np.pi, np.pi])
    for track in (_track(there_and_back, 1_000_000), _track(there_and_back, 500_000, "pedestrian")):
        torch.testing.assert_close(facing(track).world_from_box, track.world_from_box)
    one = _track([0.3], 1)
    torch.testing.assert_close(facing(one).world_from_box, one.world_from_box)


def test_the_ends_of_a_way_are_where_those_beside_them_would_take_it():
    """Tukey's rule: the median of the end, the one beside it, and the line through the smoothed two beside it, drawn on."""
    way = torch.tensor([[0.0, 0], [4, 1], [6, 1], [9, 1], [3, 5]])
    assert _steady(way).tolist() == [[0.0, 1], [4, 1], [6, 1], [6, 1], [6, 1]]


def test_a_track_has_the_middle_size_of_its_boxes():
    boxes = _boxes(np.arange(3) * 3.0)
    (track,) = tracks_of([replace(boxes, sizes=boxes.sizes * [[0.5], [1.0], [1.1]])], EGO, "here")
    assert track.size.tolist() == [4.0, 2.0, 1.5]
