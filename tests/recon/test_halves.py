"""The side of a vehicle that no picture shows is the other's mirror image, where no picture shows that either."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from quick_fit import CONFIG, SIZE

from recon import open_log
from recon.begin import begin
from recon.defaults import choose
from recon.fit.halves import INSTEAD, halves, outdone
from recon.fit.model import Splats
from recon.fit.unseen import SEEN
from recon.log import Track
from recon.objects.mirror import FEWEST, THERE
from scenes.gaussians import Gaussians
from scenes.harmonics import sh_from_rgb
from scenes.poses import translation
from scenes.shade import BLACK
from tests.recon.test_flanks import an_end

BOX = np.array([4.0, 2.0, 1.5])


def track(name: str, label: str = "car") -> Track:
    poses = torch.stack([translation(0.0, 0.0, 0.0)] * 2)
    return Track(name, label, True, BOX, np.array([0, 100_000]), poses, np.full(2, -1), ())


def panel(y: float, x: tuple[float, float] = (-1.9, 1.9), bright: float = 0.5) -> Gaussians:
    """A side of a car at `y`, a splat every tenth of a metre."""
    along, up = (v.flatten() for v in torch.meshgrid(torch.arange(*x, 0.1), torch.arange(0.3, 1.3, 0.1), indexing="ij"))
    n = len(along)
    scales = torch.tensor([0.05, 0.01, 0.05]).log().repeat(n, 1)
    sh = torch.zeros(n, 4, 3)
    sh[:, 0] = sh_from_rgb(bright)
    means = torch.stack([along, torch.full((n,), y), up], 1)
    return Gaussians(means, torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), scales, torch.full((n,), 2.0), sh)


def of(*groups: Gaussians) -> Splats:
    return Splats.of(list(groups), [torch.full((len(g),), 20.0) for g in groups])


def seen(splats: Splats, which: torch.Tensor) -> torch.Tensor:
    return torch.where(which, 0.5, 0.0)


def test_a_side_that_pictures_show_is_mirrored_where_the_other_is_not_known():
    left, front = panel(0.9), panel(-0.9, (1.0, 1.9))  # of the right one pictures show the front end
    splats = of(panel(5.0), Gaussians.cat([left, front]))
    more, reach = halves(splats, torch.full((len(splats),), 0.5), [track("veh_1")])
    assert len(more[0]) == 0 and len(more[1]) == len(reach[1]) > 200
    assert more[1].means[:, 1].tolist() == pytest.approx([-0.9] * len(more[1]))
    assert float(more[1].means[:, 0].max()) == pytest.approx(1.0 - THERE, abs=0.06), "up to what is known of it"
    assert torch.equal(more[1].sh[0, 0], left.sh[0, 0]) and (reach[1] == 20.0).all()


def test_a_car_that_is_seen_from_behind_has_sides_and_a_walker_has_none():
    rear = an_end(-1.9)
    splats = of(panel(5.0), rear, rear)
    more, reach = halves(splats, torch.full((len(splats),), 0.5), [track("veh_1"), track("ped_1", "pedestrian")])
    sides = more[1].means
    assert len(sides) == len(reach[1]) > 100 and (reach[1] >= 20.0).all() and len(more[2]) == 0
    assert float(sides[:, 0].max()) > 1.5 and (sides[:, 1].abs() > 0.75).all()


def test_who_walks_and_what_is_hardly_known_have_no_halves():
    walker, hidden, few = panel(0.9), panel(0.9), panel(0.9).select(torch.arange(FEWEST - 1))
    splats = of(panel(5.0), walker, hidden, few)
    part = seen(splats, splats.group_of() != 2)
    more, _ = halves(splats, part, [track("ped_1", "pedestrian"), track("veh_1"), track("veh_2")])
    assert [len(m) for m in more] == [0] * 4


def test_halves_are_no_more_than_there_is_room_for_the_best_known_first():
    splats = of(panel(5.0), Gaussians.cat([panel(0.9, (0.0, 1.9)), panel(-0.9, (0.0, 1.9))]), Gaussians.cat([panel(0.9), panel(-0.9)]))
    old = (splats.group_of() == 0) | (splats.fields["means"][:, 1] > 0)
    one, two = len(panel(0.9, (0.0, 1.9))), len(panel(0.9))
    for room, left in ((one + two, [one, two]), (two, [0, two]), (one, [one, 0]), (0, [0, 0])):
        gone = outdone(splats, seen(splats, old), old, torch.zeros(len(splats)), int(old.sum()) + room)
        assert not gone[old].any()
        assert [int((~old & ~gone & (splats.group_of() == i)).sum()) for i in (1, 2)] == left


def test_a_half_that_a_picture_shows_goes_and_what_none_shows_gives_way_to_one():
    body, image = panel(0.9), panel(-0.9)
    fog = panel(-0.9 + INSTEAD / 2, (-1.0, 1.0), 0.9)  # seeds that no picture ever moved
    far = panel(0.0)
    shade = replace(panel(-0.8, (-1.0, 0.0)), sh=torch.zeros(100, 4, 3))
    shade.sh[:, 0] = sh_from_rgb(BLACK)
    own = Gaussians.cat([body, fog, far, shade])
    splats = of(panel(-0.9), Gaussians.cat([own, image]))
    first = splats.sizes[0]
    names = ["street"] * first + ["body"] * len(body) + ["fog"] * len(fog) + ["far"] * len(far) + ["shade"] * 100 + ["image"] * len(image)
    named = {name: torch.tensor([n == name for n in names]) for name in set(names)}
    part, shown = seen(splats, named["body"]), seen(splats, named["image"] & (splats.fields["means"][:, 0] > 1.0))
    gone = outdone(splats, part, ~named["image"], shown, 10_000)
    assert torch.equal(gone & named["image"], shown >= SEEN)
    assert gone[named["fog"]].all()
    assert not gone[named["street"] | named["body"] | named["far"] | named["shade"]].any()


def test_a_fit_completes_what_it_knows_one_side_of_and_changes_no_picture(drive, monkeypatch):
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    car = next(i for i, t in enumerate(fit.motion.tracks, 1) if t.label == "car")
    for _ in range(30):
        fit.step()
    pictures, given = [fit.picture(v) for v in fit.training], []
    monkeypatch.setattr("recon.fit.population.halves", lambda *told: given.append(halves(*told)) or given[-1])
    fit.population.guess(fit.shown)
    part = fit.shown().part
    after = [fit.picture(v) for v in fit.training]
    assert len(fit.population.descent.last) == len(fit.splats) <= CONFIG.budget
    half = given[0][0][car].means
    mine = fit.splats.group_of() == car
    left = (fit.splats.fields["means"][mine][:, None] == half[None]).all(2).any(1)
    assert 10 < left.sum() < len(half)
    assert (part[mine][left] < SEEN).float().mean() > 0.8, "nothing, but for what others hid that are gone"
    assert max(float((a - b).abs().mean()) for a, b in zip(pictures, after, strict=True)) < 0.01
    fit.step()
