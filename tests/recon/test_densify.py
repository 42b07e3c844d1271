from types import SimpleNamespace

import numpy as np
import pytest
import torch

from recon.fit.config import FitConfig
from recon.fit.densify import BOX_MARGIN, Growth, grow, kept, shade_of
from recon.fit.model import Splats
from recon.fit.population import Population
from recon.fit.reach import NEAREST
from scenes.camera import RigCamera
from scenes.gaussians import Gaussians
from scenes.harmonics import sh_from_rgb
from scenes.lenses import Pinhole
from scenes.shade import BLACK
from scenes.trajectory import Trajectory


def some(count, seed=0, spread=0.5):
    g = torch.Generator().manual_seed(seed)
    r = lambda *s: torch.randn(*s, generator=g)  # noqa: E731
    means = r(count, 3) * spread + torch.tensor([0.0, 0, 0.7])
    return Gaussians(means, r(count, 4), r(count, 3) * 0.3 - 2, torch.ones(count), r(count, 4, 3))


def splats():
    return Splats.of([some(50), some(20, 1, 0.1), some(10, 2, 0.1)], [torch.full((n,), 10.0) for n in (50, 20, 10)])


BOXES = [np.array([2.0, 2.0, 2.0])] * 2


def wrong(s, generator=torch.Generator().manual_seed(3)):  # noqa: B008
    return as_wrong_as(torch.rand(len(s), generator=generator))


def as_wrong_as(errors):
    """One picture showed every splat and pulled at each with the same force."""
    return Growth(errors, *torch.ones(3, len(errors)))


def test_growth_ends_at_the_budget():
    s = splats()
    for left in (3, 2, 1):
        s, _ = grow(s, {}, wrong(s), 140, left, BOXES)
        s.groups(4)
    assert len(s) == 140 and sum(s.sizes) == 140
    s, _ = grow(s, {}, wrong(s), 100, 1, BOXES)
    assert len(s) == 140


def test_groups_stay_apart_when_splats_are_added_and_dropped():
    s = splats()
    s.fields["sh"] = s.group_of().float()[:, None, None].expand(-1, 4, 3).clone()
    s.fields["logits"][::7] = -9
    after, _ = grow(s, {}, wrong(s), 120, 1, BOXES)
    for i, group in enumerate(after.groups(4)):
        assert (group.sh[:, 0] == i).all()
    assert (torch.sigmoid(after.fields["logits"]) > 0.02).all() and len(after) == 120


def test_what_is_astray_goes_and_is_not_split():
    s = splats()
    astray = torch.arange(len(s)) % 3 == 0
    s.fields["sh"] = astray.float()[:, None, None].expand(-1, 4, 3).clone()
    after, _ = grow(s, {}, as_wrong_as(1 + 9 * astray.float()), 100, 1, BOXES, astray)
    assert len(after) == 100 and not after.fields["sh"].any()


def test_of_what_is_kept_everything_is():
    s = splats()
    s = Splats(s.fields, s.sizes, torch.arange(len(s)).float())
    which = torch.arange(len(s)) % 3 > 0
    after, carried = kept(s, {"mine": torch.arange(len(s))}, which)
    mine = which.nonzero()[:, 0]
    assert torch.equal(carried["mine"], mine) and torch.equal(after.group_of(), s.group_of()[mine])
    assert all(torch.equal(after.fields[k], s.fields[k][mine]) for k in s.fields) and torch.equal(after.reach, s.reach[mine])


def test_splats_of_an_actor_that_leave_its_box_are_dropped_and_the_background_is_free():
    s = splats()
    s.fields["means"][0], s.fields["means"][55] = torch.tensor([500.0, 0, -9]), torch.tensor([5.0, 0, 0])
    after, _ = grow(s, {}, Growth.none(len(s)), 80, 1, BOXES)
    assert after.sizes == [50, 19, 10]


def test_splats_of_an_actor_below_its_box_are_the_roads():
    s = splats()
    s.fields["means"][50], s.fields["means"][51] = torch.tensor([0.0, 0, -BOX_MARGIN - 0.1]), torch.tensor([0.0, 0, -BOX_MARGIN + 0.1])
    after, _ = grow(s, {}, Growth.none(len(s)), 80, 1, BOXES)
    assert after.sizes == [50, 19, 10] and (after.fields["means"] == s.fields["means"][51]).all(1).any()


def test_the_budget_lasts_for_the_rounds_that_are_left():
    s = splats()
    assert [sum(grow(s, {}, wrong(s), 100, rounds, BOXES)[0].sizes) for rounds in (1, 4)] == [100, 85]


def test_the_shade_of_an_actor_reaches_farther_than_it_does():
    s = splats()
    beside = float(BOXES[0][0]) / 2 + 1.0
    s.fields["means"][50:52] = torch.tensor([beside, 0, 0.02])
    s.fields["sh"][50] = sh_from_rgb(BLACK)
    after, _ = grow(s, {}, Growth.none(len(s)), 80, 1, BOXES)
    assert after.sizes == [50, 19, 10], "what only strayed there goes"
    assert (after.fields["sh"] == s.fields["sh"][50]).all(2).all(1).any()


def test_shade_is_what_is_black_of_actors():
    s = splats()
    s.fields["sh"][[3, 55, 61]] = sh_from_rgb(BLACK)
    assert shade_of(s).nonzero()[:, 0].tolist() == [55, 61]
    assert not shade_of(Splats.of([some(4)], [torch.ones(4)])).any(), "a street without actors"


def test_a_split_keeps_the_place_and_halves_the_length():
    s = Splats.of([some(1)], [torch.ones(1)])
    s.fields["log_scales"] = torch.tensor([[0.0, -2.0, -3.0]])
    s.fields["quats"] = torch.tensor([[1.0, 0, 0, 0]])
    middle = s.fields["means"].clone()
    after, _ = grow(s, {}, as_wrong_as(torch.ones(1)), 2, 1, [])
    torch.testing.assert_close(after.fields["means"].mean(0, keepdim=True), middle)
    torch.testing.assert_close((after.fields["means"][0] - after.fields["means"][1]).abs(), torch.tensor([1.0, 0, 0]))
    assert (after.fields["log_scales"][:, 0] < -0.4).all()


def test_what_splats_carry_follows_them_and_new_ones_start_at_zero():
    s = splats()
    after, carried = grow(s, {"moments": torch.ones(len(s), 2, 5), "age": torch.ones(len(s))}, wrong(s), 90, 1, BOXES)
    assert carried["moments"].shape == (90, 2, 5) and carried["moments"][:, 1, 4].sum() == carried["age"].sum() == 80


def test_those_are_split_that_are_most_in_need_in_the_mean_picture():
    s = splats()
    growth = Growth.none(len(s))
    for errors in ([5.0, 4.0, 0.0, 9.0], [5.0, 0.0, 0.0, 9.0]):  # 4 in the one picture that shows it is less than 5, and more than nothing
        growth.blame(torch.tensor([7, 60, 75, 76]), torch.tensor(errors))
    assert growth.shown[[7, 60, 75, 76, 0]].tolist() == [2, 1, 0, 2, 0]
    growth.pull[[7, 60, 75]], growth.pulled[[7, 60, 75]] = torch.tensor([4.0, 2.0, 100.0]), torch.tensor([4.0, 2.0, 1.0])
    torch.testing.assert_close(growth.need()[[7, 60, 75, 76]], torch.tensor([5**0.5, 2.0, 0.0, 0.0]))
    first, _ = grow(s, {}, growth, 81, 1, BOXES)
    assert first.sizes == [51, 20, 10]
    both, _ = grow(s, {}, growth, 99, 1, BOXES)
    assert both.sizes == [51, 21, 10], "nothing is wrong with the others, or nothing pulls at them"


@pytest.mark.parametrize(("budget", "room"), [(200, 30), (92, 12), (80, 0), (70, 0)])
def test_what_is_added_to_the_background_takes_no_more_room_than_there_is(budget, room):
    standing = Trajectory(torch.zeros(1, dtype=torch.int64), torch.eye(4, dtype=torch.float64)[None])
    motion = SimpleNamespace(rig=[RigCamera(Pinhole(100.0, 100.0, 50.0, 50.0), 100, 100, torch.eye(4))], tracks=[])
    nobody = SimpleNamespace(to=lambda device: None)
    there = Population(splats(), motion, FitConfig(budget=budget), SimpleNamespace(ground=None), nobody, None, None, NEAREST)
    more = some(30, 4)
    there.add(more, standing)
    assert there.splats.sizes == [50 + room, 20, 10] and len(there.growth.errors) == len(there.splats) == 80 + room
    more, some_of = more.log_scales, there.splats.fields["log_scales"][50 : 50 + room]
    assert not room or float(some_of.mean() - more.mean()) == pytest.approx(np.log(30 / room) / 2, abs=0.2), "wider, as they are fewer"
