"""Nothing stands where lidar looked through."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from made_sweeps import Box, drive, standing

from recon.fit.clear import ABOVE, FAR, LOOKS, Clear
from recon.log import Track
from scenes.ground import Ground
from scenes.poses import translation
from tests.recon.test_swept import splats

EVER = (-(10**9), 10**9)
FLAT = Ground(torch.zeros(2, 2), (0.0, 0.0), 1.0)
THINGS = [standing(30, 0, (1, 60, 8)), standing(12, -5), standing(20, 4, (0.3, 0.3, 5.0))]


def held(log, *places, actors=()):
    return Clear.of(log, EVER, FLAT).holds(splats(*places, actors=actors)).tolist()


def test_what_hangs_before_what_lidar_saw_goes_and_what_it_struck_or_could_not_see_stays():
    log = drive(THINGS, count=12)
    clear = {"over the road": (18.0, -1.0, 1.2), "beside the pole": (20.0, 2.0, 1.5)}
    kept = {
        "the wall": (29.4, 3.0, 2.0),
        "just before the wall": (29.2, 3.0, 2.0),
        "behind it": (34.0, 3.0, 2.0),
        "the pole": (20.0, 4.0, 1.5),
        "within the parked car": (12.0, -5.0, 0.8),
        "on the road": (18.0, -1.0, 0.1),
        "above what the lidar sees": (18.0, -1.0, 9.0),
        "far away": (150.0, 0.0, 1.5),
    }
    found = held(log, *clear.values(), *kept.values(), actors=[list(clear.values())])
    assert dict(zip([*clear, *kept], found, strict=False)) == {k: k in clear for k in [*clear, *kept]}
    assert found[len(clear) + len(kept) :] == [False] * len(clear), "an actor's are where it is at other times"


def test_where_nothing_came_back_nothing_is_near():
    """Beside a wall in front the lidar's beams go into the sky; what stood three metres away would have been struck."""
    log = drive(THINGS, count=12)
    beside = (6.0, 3.0, 2.0)
    assert held(log, beside) == [True]
    assert held(replace(log, lidars={}), beside) == [False], "of a lidar that stands nobody knows where nothing is known"


def test_what_drove_there_is_not_there():
    """Of a car that pulled out a tenth of all sweeps and more struck its roof: a ghost of it, left standing there, must go."""
    size = (4.4, 1.8, 1.5)
    log = drive([*THINGS, Box(size, lambda t: (12 + 10 * t, 3.0, 0.0))], count=12)
    times = np.arange(12) * 100_000
    boxes = torch.stack([translation(12 + 10 * t / 1e6, 3.0, 0.0) for t in times])
    car = Track("veh_1", "car", True, np.array(size), times, boxes, np.zeros(12, np.int64), ("a",))
    roof, wall = (13.0, 3.0, 1.45), (29.4, 3.0, 2.0)
    assert held(log, roof, wall) == [False, False], "nobody knows that it is a car's"
    assert held(replace(log, tracks=(car,)), roof, wall) == [True, False]
    assert held(replace(log, tracks=(replace(car, moving=False),)), roof, wall) == [False, False]


def test_a_drive_without_lidar_knows_nothing():
    log = drive(THINGS, count=4)
    assert held(replace(log, sweeps=()), (18.0, -1.0, 1.2)) == [False]


def test_some_sweeps_of_a_long_drive_are_asked():
    log = drive(THINGS, count=LOOKS + 9)
    assert len(Clear.of(log, EVER, FLAT).images) == LOOKS


@pytest.mark.parametrize(
    ("through", "there", "clear"),
    [(4, 0, True), (3, 0, False), (10, 1, True), (9, 1, False), (20, 2, True), (19, 2, False), (20, 3, False)],
)
def test_what_some_sweeps_struck_is_clear_where_ten_times_as_many_looked_through(through, there, clear):
    told = [(True, False)] * through + [(False, True)] * there + [(False, False)] * (LOOKS - through - there)
    images = [
        SimpleNamespace(middle=np.zeros(3), votes_with_silence=lambda xyz, vote=vote: np.tile(np.array(vote)[:, None], len(xyz)))
        for vote in told
    ]
    assert Clear(images, FLAT).holds(splats((5.0, 0.0, 1.0))).tolist() == [clear]


def test_along_the_road_and_far_away_lidar_is_not_asked():
    image = SimpleNamespace(middle=np.zeros(3), votes_with_silence=lambda xyz: np.tile([[True], [False]], len(xyz)))
    places = (5.0, 0.0, ABOVE - 0.1), (5.0, 0.0, ABOVE + 0.1), (FAR - 1, 0.0, 1.0), (FAR + 1, 0.0, 1.0)
    assert Clear([image] * LOOKS, FLAT).holds(splats(*places)).tolist() == [False, True, True, False]


def test_what_lidar_struck():
    log = drive(THINGS, count=12)
    places = np.array([(29.4, 3.0, 2.0), (20.0, 4.0, 1.5), (18.0, -1.0, 1.2), (34.0, 3.0, 2.0), (18.0, -1.0, 9.0)])
    assert Clear.of(log, EVER, FLAT).struck(places).tolist() == [True, True, False, False, False]
    assert not Clear.of(replace(log, sweeps=()), EVER, FLAT).struck(places).any()
