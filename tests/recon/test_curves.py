from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.log import Track
from recon.objects.curves import curved
from recon.objects.tracks import upright

SPEED, TURN, BRAKES = 6.0, 0.5, 1.0
"""Of a car that turns left at a crossing: metres and radians a second, metres per second squared."""


def _turning(times_us: np.ndarray) -> Track:
    seconds = times_us / 1e6
    way, heading = SPEED * seconds - BRAKES * seconds**2 / 2, TURN * seconds
    fine = np.linspace(-1, 5, 6001)  # the path is the integral of the direction
    steps = (SPEED - BRAKES * fine[:-1]) * 1e-3
    places = [np.concatenate([[0.0], np.cumsum(steps * f(TURN * fine[:-1]))]) for f in (np.cos, np.sin)]
    xyz = np.stack([*(np.interp(seconds, fine, p) for p in places), 0 * way], 1)
    return Track("veh_1", "car", True, np.array([4.0, 2, 1.5]), times_us, upright(xyz, heading), np.zeros(len(xyz), np.int64), ("a",))


def _off(track: Track, times_us: np.ndarray) -> np.ndarray:
    at = torch.from_numpy(times_us)
    return (track.trajectory().near_each(at) - _turning(times_us).world_from_box)[:, :2, 3].norm(dim=1).numpy()


def test_a_car_that_turns_keeps_to_its_curve_between_boxes_half_a_second_apart():
    rare = _turning(np.arange(9) * 500_000)
    between, beyond = (
        np.arange(0, 4_000_001, 20_000),
        np.concatenate([np.arange(-250_000, 0, 10_000), np.arange(4_000_001, 4_250_000, 10_000)]),
    )
    assert _off(rare, between).max() > 0.08 and _off(rare, beyond).max() > 0.2
    assert _off(curved(rare), between).max() < 0.02 and _off(curved(rare), beyond).max() < 0.13


def test_it_goes_through_its_boxes_and_exists_as_long_as_before():
    rare = _turning(np.cumsum([0, 500_000, 510_000, 480_000, 700_000]))
    made = curved(rare)
    assert made.trajectory().span_us() == rare.trajectory().span_us()
    kept = np.isin(made.times_us, rare.times_us)
    torch.testing.assert_close(made.world_from_box[kept], rare.world_from_box)
    assert (made.sensor == np.where(kept, 0, -1)).all() and (np.diff(made.times_us) <= 120_000).all()


@pytest.mark.parametrize("step_us", [100_000, 250_000, 1_000_000])
def test_boxes_that_are_close_or_between_which_nobody_knows_get_none_between(step_us):
    track = _turning(np.arange(4) * step_us)
    assert curved(track) is track
    rare = _turning(np.arange(4) * 500_000)
    assert curved(replace(rare, moving=False)).times_us is rare.times_us
