"""What hangs on the line of sight to something that moves, and what stands there."""

import numpy as np
import pytest
import torch

from recon.fit.model import Splats
from recon.fit.veils import ABOVE, AHEAD, FAR, Veils
from recon.log import Track
from scenes import Pinhole
from scenes.camera import RigCamera
from scenes.gaussians import Gaussians
from scenes.ground import Ground
from scenes.poses import CAM_FROM_FLU, inverse, translation

FLAT = Ground(torch.zeros(300, 300), (-75.0, -75.0), 0.5)
STEP_US = 100_000
RIG = RigCamera(Pinhole(200.0, 200.0, 160.0, 90.0), 320, 180, inverse(CAM_FROM_FLU))


def cameras(*xs):
    """Taken from 1.5 m above places along x, one after the other."""
    return [RIG.at(translation(x, 0.0, 1.5), STEP_US * k) for k, x in enumerate(xs)]


def car(*xs, moving=True):
    """A car of 4 x 2 x 1.6 m on x, at the times of cameras; nowhere where None."""
    there = [k for k, x in enumerate(xs) if x is not None]
    poses = torch.stack([translation(xs[k], 0.0, 0.0) for k in there])
    return Track("veh_1", "car", moving, np.array([4.0, 2.0, 1.6]), STEP_US * np.array(there), poses, np.full(len(there), -1), ())


def splats(*places):
    means = torch.tensor(places, dtype=torch.float32)
    n = len(means)
    made = Gaussians(means, torch.eye(4)[:1].expand(n, 4).clone(), torch.zeros(n, 3), torch.zeros(n), torch.zeros(n, 1, 3))
    return Splats.of([made, made], [torch.ones(n)] * 2)


def held(seen, tracks, *places):
    mask = Veils.of(seen, tracks, FLAT).holds(splats(*places))
    assert not mask[len(places) :].any(), "an actor's own"
    return mask[: len(places)].tolist()


def test_what_hangs_before_a_car_goes_and_nothing_else():
    seen, track = cameras(0.0, 0.5), car(14.0, 13.5)
    front = 11.5  # the nearest that it comes
    beside, above, behind, low = (6.0, 2.0, 1.2), (6.0, 0.0, 2.4), (front + 1, 0.0, 1.0), (6.0, 0.0, ABOVE - 0.05)
    at_it = (front - AHEAD[0] * 0.9, 0.0, 1.0)
    assert held(seen, [track], (6.0, 0.0, 1.2), (9.0, 0.3, 0.9)) == [True, True]
    assert held(seen, [track], beside, above, behind, low, at_it) == [False] * 5
    assert held(seen, [car(14.0, 13.5, moving=False)], (6.0, 0.0, 1.2)) == [False]
    assert held(seen, [car(FAR + 12, FAR + 12)], (6.0, 0.0, 1.2)) == [False]


@pytest.mark.parametrize(("passes", "goes"), [(6, True), (2, False)])
def test_what_is_seen_before_other_things_too_stands_there(passes, goes):
    """A pole that we drive towards, and a car that is behind it in some pictures."""
    xs = [0.1 * k for k in range(10)]
    track = car(*(14.0 if k < passes else None for k in range(10)))
    assert held(cameras(*xs), [track], (7.0, 0.0, 1.2)) == [goes]


def test_near_pictures_say_more_than_far_ones():
    """From afar it takes a pixel, whatever is behind it."""
    far, near = [-30.0 + k for k in range(12)], [2.0, 2.5, 3.0]
    track = car(*[None] * len(far), *[14.0] * len(near))
    assert held(cameras(*far, *near), [track], (7.0, 0.0, 1.2)) == [True]


def test_without_movers_nothing_is_asked():
    assert Veils.of(cameras(0.0, 1.0), [], FLAT).showing == []
