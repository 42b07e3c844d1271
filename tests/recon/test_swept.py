import numpy as np
import torch

from recon.fit.model import Splats
from recon.fit.swept import ABOVE, WITHIN, Swept
from recon.log import Track
from scenes.gaussians import Gaussians
from scenes.ground import Ground
from scenes.poses import translation

DEEP = Ground(torch.full((2, 2), -9.0), (0.0, 0.0), 1.0)


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


def test_nothing_stands_where_a_car_drove():
    swept = Swept([car([0, 500_000], (0.0, 5.0, 1.0), (12.0, 5.0, 2.0))], DEEP, "cpu")
    hit = [(-1.5, 5, 1.8), (6, 5.5, 2.5), (6.1, 4.3, 2.2), (13.5, 5, 3)]
    free = [(6, 5, 1.5 + ABOVE / 2), (6, 5, 3.3), (6, 6.2, 2.2), (-2.4, 5, 1.8), (14.4, 5, 3), (6, 50, 2), (-600, 5, 2)]
    assert swept.holds(splats(*hit, *free)).tolist() == [True] * len(hit) + [False] * len(free)
    along = np.arange(-2 + 2 * WITHIN, 14 - 2 * WITHIN, 0.03)
    assert swept.holds(splats(*((x, 5.3, 1 + max(0.0, x) / 12 + 0.8) for x in along))).all(), "between its boxes, too"


def test_where_it_was_not_seen_for_long_nobody_knows():
    swept = Swept([car([0, 2_000_000], (0.0, 0.0, 0.0), (40.0, 0.0, 0.0))], DEEP, "cpu")
    assert swept.holds(splats((0, 0, 1), (20, 0, 1), (40, 0, 1))).tolist() == [True, False, True]


def test_what_moves_itself_may_stand_there_and_a_drive_without_movers_pays_nothing():
    swept = Swept([car([0], (0.0, 0.0, 0.0))], DEEP, "cpu")
    assert swept.holds(splats((0, 0, 1), actors=[[(0, 0, 1)]])).tolist() == [True, False]
    assert not Swept([], DEEP, "cpu").holds(splats((0, 0, 1))).any()


def test_as_low_as_the_lowest_and_as_high_as_the_highest_that_passed():
    low, high = car([0], (0.0, 0.0, 0.0)), car([0], (0.0, 0.0, 1.0))
    heights = [0.2, 0.5, 1.5, 2.3, 2.5]
    assert Swept([low, high], DEEP, "cpu").holds(splats(*((0, 0, z) for z in heights))).tolist() == [False, True, True, True, False]


def test_a_road_that_rises_through_a_level_box_stays():
    heights = torch.tensor([[-0.4, 0.4], [-0.4, 0.4]])
    swept = Swept([car([0], (0.0, 0.0, 0.0))], Ground(heights, (-2.0, -2.0), 4.0), "cpu")
    assert swept.holds(splats((1.5, 0, 0.35), (1.5, 0, 0.9), (-1.5, 0, 0.4))).tolist() == [False, True, True]
