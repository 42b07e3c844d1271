from dataclasses import replace

import numpy as np
import torch

from recon.fit.model import Splats
from recon.fit.swept import ABOVE, CELL, CLOSE, POSES, STOOD, Swept
from recon.log import Track
from scenes.gaussians import Gaussians
from scenes.ground import Ground
from scenes.poses import translation, yaw

DEEP = Ground(torch.full((2, 2), -9.0), (0.0, 0.0), 1.0)
EVER = (-(10**9), 10**9)
NONE = np.zeros((0, 3)), np.zeros(0, np.int64)


def car(times_us, *places):
    """A car of 4 x 2 x 1.6 m that faces along x, its base at some places."""
    poses = torch.stack([translation(*place) for place in places])
    return Track("veh_1", "car", True, np.array([4.0, 2.0, 1.6]), np.array(times_us), poses, np.zeros(len(times_us)), ())


def splats(*places, actors=()):
    def at(places):
        means = torch.tensor(places, dtype=torch.float32).reshape(-1, 3)
        n = len(means)
        return Gaussians(means, torch.eye(4)[:1].expand(n, 4).clone(), torch.zeros(n, 3), torch.zeros(n), torch.zeros(n, 1, 3))

    groups = [at(places), *(at(a) for a in actors)]
    return Splats.of(groups, [torch.ones(len(g)) for g in groups])


def held(tracks, *places, span=EVER, ground=DEEP, static=NONE):
    return Swept.by(tracks, span, ground, *static).holds(splats(*places)).tolist()


def test_nothing_stands_where_a_car_drove():
    track = car([0, 500_000], (0.0, 5.0, 1.0), (12.0, 5.0, 2.0))
    hit = [(-1.5, 5, 1.8), (6, 5.5, 2.5), (6.1, 4.3, 2.2), (13.5, 5, 3)]
    free = [(6, 5, 1.55), (6, 5, 3.3), (6, 6.2, 2.2), (-2.4, 5, 1.8), (14.4, 5, 3), (6, 50, 2), (-600, 5, 2)]
    assert held([track], *hit, *free) == [True] * len(hit) + [False] * len(free)
    along = np.arange(-2 + CLOSE + CELL, 14 - CLOSE - CELL, 0.03)
    assert all(held([track], *((x, 5.3, 1 + max(0.0, x) / 12 + 0.8) for x in along))), "between its boxes, too"


def test_as_much_as_the_box_holds_however_it_stands():
    pose = translation(3.03, -7.04, 0.51) @ yaw(0.5)
    track = replace(car([0], (0.0, 0.0, 0.0)), world_from_box=pose[None])
    rng = np.random.default_rng(0)
    local = rng.uniform([-2.5, -1.5, -0.5], [2.5, 1.5, 2.0], (20_000, 3))
    within = np.minimum(2 - np.abs(local[:, 0]), 1 - np.abs(local[:, 1])) - CLOSE
    within = np.minimum(within, np.minimum(local[:, 2] - ABOVE, 1.6 - CLOSE - local[:, 2]))
    found = np.array(held([track], *(local @ pose[:3, :3].numpy().T + pose[:3, 3].numpy()).tolist()))
    corner = CELL * 3**0.5 / 2
    assert found[within > corner].all() and not found[within < -corner].any()
    assert abs(found.mean() / (within > 0).mean() - 1) < 0.1


def test_a_box_that_leans_or_turns_on_the_spot():
    lean = 0.2
    up = torch.tensor([[np.cos(lean), 0, -np.sin(lean), 0], [0, 1, 0, 0], [np.sin(lean), 0, np.cos(lean), 0], [0, 0, 0, 1.0]])
    rises = replace(car([0], (0.0, 0.0, 0.0)), world_from_box=up[None].double())
    assert held([rises], (1.4, 0, 0.45), (1.4, 0, 0.9), (-1.4, 0, 0.45), (-1.4, 0, 1.3)) == [False, True, True, False]
    turns = replace(car([0, 500_000], (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), world_from_box=torch.stack([yaw(0.0), yaw(1.4)]))
    around = [(1.6 * np.cos(a), 1.6 * np.sin(a), 0.8) for a in np.linspace(0, 1.4, 40)]
    assert all(held([turns], *around)) and held([turns], (1.6 * np.cos(-0.9), 1.6 * np.sin(-0.9), 0.8)) == [False]


def test_a_long_way_is_swept_as_its_parts_are():
    long_way = [(0.15 * i, 3 * np.sin(i / 99), 0.001 * i) for i in range(3 * POSES)]
    found = held([car((np.arange(len(long_way)) * 10_000).tolist(), *long_way)], *((x, y, z + 0.8) for x, y, z in long_way))
    assert len(found) == 3 * POSES and all(found)


def test_where_it_was_not_seen_for_long_nobody_knows():
    track = car([0, 2_000_000], (0.0, 0.0, 0.0), (40.0, 0.0, 0.0))
    assert held([track], (0, 0, 1), (20, 0, 1), (40, 0, 1)) == [True, False, True]


def test_what_comes_before_or_after_the_pictures_does_not_count():
    track = car([0, 500_000, 1_000_000], (0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (20.0, 0.0, 0.0))
    assert held([track], (0, 0, 1), (10, 0, 1), (20, 0, 1), span=(400_000, 600_000)) == [False, True, False]


def test_what_moves_itself_may_stand_there_and_a_drive_without_movers_pays_nothing():
    swept = Swept.by([car([0], (0.0, 0.0, 0.0))], EVER, DEEP, *NONE)
    assert swept.holds(splats((0, 0, 1), actors=[[(0, 0, 1)]])).tolist() == [True, False]
    assert held([], (0, 0, 1)) == [False]


def test_a_bridge_between_two_roads_stays():
    below, above = car([0], (0.0, 0.0, 0.0)), car([0], (0.0, 0.0, 6.0))
    heights = (0.1, 0.9, 3.0, 5.9, 6.2, 6.9, 7.9)
    found = held([below, above], *((0, 0, z) for z in heights))
    assert [z for z, empty in zip(heights, found, strict=True) if empty] == [0.9, 6.9]


def test_a_road_that_rises_through_a_level_box_stays():
    heights = torch.tensor([[-0.4, 0.4], [-0.4, 0.4]])
    level = car([0], (0.0, 0.0, 0.0))
    assert held([level], (1.5, 0, 0.45), (1.5, 0, 0.9), (-1.5, 0, 0.4), ground=Ground(heights, (-2.0, -2.0), 4.0)) == [False, True, True]


def test_a_parked_car_stays_where_another_passed_through_its_box():
    """Annotators give a car that parks a new name at times."""
    moving = car([0, 700_000], (-10.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    parked = replace(car([800_000], (0.0, 0.0, 0.0)), moving=False)
    assert held([moving, parked], (-8, 0, 1), (0, 0, 1), (0, 0.9, 1), (1.9, 0, 1.5)) == [True, False, False, False]
    beside = replace(car([800_000], (0.0, 1.6, 0.0)), moving=False)  # its box may be drawn too small
    assert held([moving, beside], (-8, 0.5, 1), (0, 0.5, 1), (0, 0.1, 1)) == [True, False, True]


def test_what_lidar_saw_standing_there_at_another_time_stays():
    track = car([0, 700_000], (-10.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    side = np.array([[x, -0.7, 0.9] for x in np.arange(-1.5, 1.5, 0.05)])

    def seen(sweeps, every_us=100_000):
        return np.tile(side, (sweeps, 1)), np.repeat(np.arange(sweeps) * every_us, len(side))

    asked = [(0, -0.7, 0.6), (0, -0.7, 1.2), (0, -0.7 + CELL, 1), (0, 0.5, 1), (-8, -0.7, 1)]
    assert held([track], *asked, static=seen(STOOD)) == [False, False, False, True, True]
    assert held([track], *asked, static=seen(STOOD - 1)) == [True] * 5, "something passed"
    assert held([track], *asked, static=seen(2 * STOOD - 2, 50_000)) == [True] * 5, "as fast before a lidar that turns faster"
    assert held([track], *asked, static=seen(2 * STOOD, 50_000)) == [False, False, False, True, True]
    points, times = seen(3 * STOOD)
    elsewhere = np.full((9 * STOOD, 3), 99.0), np.arange(9 * STOOD) * 100_000
    now_and_then = np.concatenate([points, elsewhere[0]]), np.concatenate([3 * times, elsewhere[1]])
    assert held([track], *asked, static=now_and_then) == [True] * 5
    road = np.tile([[0.0, 0.0, 0.05]], (50, 1)), np.arange(50) * 100_000
    assert held([track], (0, 0, 1), static=road) == [True]
