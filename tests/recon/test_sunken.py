"""Points of pictures that seem to lie under the road go; valleys beside it, and what is under a road that nobody knows, stay."""

from dataclasses import replace

import numpy as np
import pytest
from painted import drive

from recon.log import SparsePoints
from recon.seeds.sunken import without_sunken

STEPS = [2.0] * 12
"""Metres from picture to picture."""


@pytest.fixture(scope="module")
def log():
    return drive(STEPS, ("front",))


def road(count=600, seed=0):
    """Points of the road around the path, at 0."""
    chance = np.random.default_rng(seed)
    return np.column_stack([chance.uniform(-5, 35, count), chance.uniform(-4, 4, count), chance.normal(0, 0.02, count)])


def seen(log, *parts):
    """All points, of which every picture shows those of all parts; and where the parts begin."""
    xyz = np.concatenate(parts)
    frames = len(log.camera("front"))
    return SparsePoints(xyz, {"front": (np.arange(len(xyz)),) * frames}), np.cumsum([0, *map(len, parts)])


def beneath(ahead, left, times, log):
    """Points `times` as far from the first picture as the road is in that direction."""
    eye = log.camera("front").world_from_cam[0, :3, 3].numpy()
    return eye + times * (np.array([[ahead, left, 0.0]]) - eye)


def test_what_is_seen_through_the_road_goes_and_the_rest_keeps_its_pictures(log):
    above = np.array([[20.0, 0.0, 2.0], [20.0, 3.0, 5.0]])
    points, at = seen(log, road(), beneath(40.0, 0.5, 5.0, log), above)
    points = replace(points, seen={"front": (*points.seen["front"][:3], np.array([at[2], at[2] + 1]), *points.seen["front"][4:])})
    kept = without_sunken(points, log, log.ego)
    assert len(kept.xyz) == len(points.xyz) - 1 and (kept.xyz[:, 2] > -0.3).all()
    for before, after in zip(points.seen["front"], kept.seen["front"], strict=True):
        np.testing.assert_array_equal(kept.xyz[after], points.xyz[before][points.xyz[before][:, 2] > -0.3])


def test_a_valley_beside_the_road_stays(log):
    valley = beneath(15.0, 20.0, 1.5, log)
    points, _ = seen(log, road(), valley)
    assert without_sunken(points, log, log.ego).xyz.tolist() == points.xyz.tolist()


@pytest.mark.parametrize("count", [0, 20, 120])
def test_below_a_road_that_points_do_not_show_everything_stays(log, count):
    """As where the path is high above it, and what is there lies at any depth."""
    deep = np.random.default_rng(1).uniform((0, -4, -30), (30, 4, -3), (600, 3))
    points, _ = seen(log, road(count), deep)
    assert len(without_sunken(points, log, log.ego).xyz) == len(points.xyz)


def test_a_world_that_is_not_metric_stays_as_it_is(log):
    points, _ = seen(log, road(), beneath(40.0, 0.5, 5.0, log))
    other = replace(log, meta={**log.meta, "metric": False})
    assert without_sunken(points, other, log.ego) is points
