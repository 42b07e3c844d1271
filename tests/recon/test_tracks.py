import numpy as np
import pytest
import torch

from recon.log import Track
from recon.tracks import facing, upright


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


def test_what_has_time_to_turn_round_may():
    there_and_back = np.array([0.0, 0, 0, np.pi, np.pi])
    for track in (_track(there_and_back, 1_000_000), _track(there_and_back, 500_000, "pedestrian")):
        torch.testing.assert_close(facing(track).world_from_box, track.world_from_box)
    one = _track([0.3], 1)
    torch.testing.assert_close(facing(one).world_from_box, one.world_from_box)
