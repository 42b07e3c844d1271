"""What pictures hardly show is told from what they do, and takes its neighbours' colours."""

import math
from dataclasses import replace

import pytest
import torch
from quick_fit import CONFIG, SIZE

from recon import open_log
from recon.begin import begin
from recon.defaults import choose
from recon.fit.fit import GUESSED_FROM
from recon.fit.model import Splats
from recon.fit.unseen import NEIGHBOURS, SEEN, SWOLLEN, Shown, as_neighbours, curtains, footprint, pennants, swollen
from render import rasterize
from scenes.camera import Camera
from scenes.gaussians import Gaussians, Placed
from scenes.ground import Ground
from scenes.harmonics import sh_from_rgb
from scenes.lenses import Fisheye, Pinhole
from scenes.shade import BLACK
from tests.bench.presets import random_splats

AHEAD = Camera(Pinhole(160.0, 160.0, 128.0, 96.0), 256, 192, torch.eye(4, dtype=torch.float64))

DEEP = Ground(torch.full((9, 9), -50.0), (-4.0, -4.0), 1.0)


def balls(places: list[tuple[float, float, float]], metres: list[float], opacity: list[float]) -> Gaussians:
    """Round splats of standard deviations `metres`."""
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(len(places), 4).contiguous()
    scales = torch.tensor(metres).log()[:, None].expand(-1, 3).contiguous()
    return Gaussians(torch.tensor(places), quats, scales, torch.logit(torch.tensor(opacity)), torch.zeros(len(places), 1, 3))


def shown_ahead(splats: Gaussians, sky: torch.Tensor | None = None) -> Shown:
    """What one picture shows of splats; sky: its pixels beside the sky, none where None."""
    shown = Shown.none(len(splats))
    beside = torch.zeros(AHEAD.height, AHEAD.width) if sky is None else sky
    shown.add(torch.arange(len(splats)), [Placed(splats, torch.eye(4, dtype=torch.float64))], AHEAD, beside)
    return shown


def test_what_stands_before_a_splat_is_taken_off():
    splats = balls([(0.0, 0, 10), (0.0, 0, 4), (2.0, 2, 8), (60.0, 0, 8)], [0.5, 0.4, 0.4, 0.4], [0.9, 0.95, 0.7, 0.9])
    behind, before, free, outside = shown_ahead(splats).part.tolist()
    assert before == pytest.approx(1, abs=0.05) and free == pytest.approx(1.2, abs=0.1) and outside == 0
    assert behind == pytest.approx(1 - 0.95 * 0.8, abs=0.02), "two Gaussians, one twice as wide"
    assert float(shown_ahead(splats.select(torch.tensor([0]))).part) == pytest.approx(1, abs=0.05)


def test_of_several_pictures_the_one_that_shows_most_counts_and_weights_add_up():
    splats = balls([(0.0, 0, 10), (60.0, 0, 8)], [0.5, 0.4], [0.9, 0.9])
    once, both = shown_ahead(splats), shown_ahead(splats)
    hidden = balls([(0.0, 0, 10), (0.0, 0, 2)], [0.5, 1.0], [0.9, 0.999])
    both.add(torch.tensor([0, 1]), [Placed(hidden, torch.eye(4, dtype=torch.float64))], AHEAD, torch.ones(AHEAD.height, AHEAD.width))
    assert float(both.part[0]) == pytest.approx(float(once.part[0])) and both.inside.tolist() == [True, True]
    assert 0 < float(both.weight[0] - once.weight[0]) < 0.05 * float(once.weight[0])
    torch.testing.assert_close(both.beside_sky, both.weight - once.weight)


def test_what_peeps_over_a_roof_before_the_sky_hangs_there_from_aside():
    """A wall below the sky, and behind its edge what shows a little over it; the same behind the wall's middle; what stands free beside the
    sky; and an actor's."""
    edge = torch.zeros(AHEAD.height, AHEAD.width)
    edge[:132] = 1
    places = [(x, 1.3 + 0.1 * y, 6.0) for x in torch.linspace(-3, 3, 60).tolist() for y in range(30)]
    behind = [(0.0, 2.9, 12.0), (0.0, 5.5, 12.0), (4.0, -3.0, 12.0)]
    splats = balls([*places, *behind], [0.1] * len(places) + [0.3] * 3, [0.95] * (len(places) + 3))
    shown = shown_ahead(splats, edge)
    peeps, hidden, free = shown.part[-3:].tolist()
    assert 0.001 < peeps < SEEN and hidden < 0.001 and free > 0.9
    high = Ground(torch.full((9, 9), -50.0), (-4.0, -4.0), 1.0)
    alone = Splats.of([splats], [torch.ones(len(splats))])
    found = pennants(alone, shown, high)
    assert found[-3:].tolist() == [True, False, False] and not found[:-3].any()
    groups = [splats.select(which) for which in torch.arange(len(splats)).split([len(places), 3])]
    assert not pennants(Splats.of(groups, [torch.ones(len(g)) for g in groups]), shown, high).any(), "an actor is whole"
    street = Ground(torch.full((9, 9), 12.0), (-4.0, -4.0), 1.0)
    assert not pennants(alone, shown, street)[-3:].any()


def test_a_splats_whole_weight_is_that_of_its_ellipse():
    """However it is turned, stretched and seen, where nothing else is drawn: what is measured is what a picture sums up to."""
    generator = torch.Generator().manual_seed(3)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.3, -0.2, 0.5])
    for lens in (AHEAD.lens, Fisheye(160.0, 160.0, 128.0, 96.0)):
        camera = replace(AHEAD, lens=lens)
        for _ in range(6):
            turn = torch.randn(1, 4, generator=generator)
            scales = 0.2 + 0.4 * torch.rand(1, 3, generator=generator)
            one = replace(balls([(0.5, 0.4, 7.0)], [1.0], [0.8]), quats=turn, log_scales=scales.log())
            drawn = rasterize([Placed(one, pose)], camera, ("alpha",)).alpha.sum()
            assert float(footprint(Placed(one, pose), camera)) == pytest.approx(float(drawn), rel=0.12)


def test_what_only_its_rim_shows_is_a_curtain_unless_it_is_the_street():
    """Three that stand, one of which is seen whole and one never, one on the ground, and an actor's."""
    some = balls([(0.0, 0, 5), (0.0, 0, 5), (0.0, 0, 5), (1.0, 0, 4.1)], [1.0] * 4, [0.9] * 4)
    splats = Splats.of([some, balls([(0.0, 0, 5)], [1.0], [0.9])], [torch.ones(4), torch.ones(1)])
    street = Ground(torch.full((9, 9), 4.0), (-4.0, -4.0), 1.0)
    inside = torch.tensor([False, True, False, False, False])
    pulled = torch.tensor([True, True, False, True, True])
    assert curtains(splats, inside, pulled, street).tolist() == [True, False, False, False, False]


def test_a_fit_of_one_standing_camera_hangs_no_curtain_beside_its_pictures(street, drive, tmp_path):
    log = open_log(drive)
    names, span = choose(log, ["front_camera"])
    _, fit = begin(log, names, span, SIZE, replace(CONFIG, steps=120), 4)
    while fit.step_count < 120:
        fit.step()
    background = fit.splats.select(torch.arange(fit.splats.sizes[0]), 1)
    inside = torch.zeros(len(background), dtype=torch.bool)
    for view in fit.training:
        placed = Placed(background.groups(1)[0].detach(), torch.eye(4, dtype=torch.float64))
        inside |= footprint(placed, fit.motion.camera(view).resized(*SIZE)) > 0
    left = curtains(background, inside, fit.population.descent.coloured()[: len(background)], fit.population.ground)
    assert float(left.float().mean()) < 0.0015, "none but what went beyond the border since; 0.0035 where they stay"


def test_what_swells_behind_a_car_ahead_goes_and_seeds_and_shade_stay():
    metres = [1.2 * SWOLLEN, 0.8 * SWOLLEN, 1.2 * SWOLLEN]
    some = balls([(0.0, 0, 10), (1.0, 0, 10), (2.0, 0, 10)], metres, [0.9] * 3)
    coloured = replace(some, sh=sh_from_rgb(torch.full((3, 1, 3), 0.6)))
    shade = replace(some, sh=torch.full((3, 1, 3), sh_from_rgb(BLACK)))
    splats = Splats.of([coloured, Gaussians.cat([coloured, shade])], [torch.full((3,), 20.0), torch.full((6,), 20.0)])
    hidden, known = torch.zeros(9), torch.full((9,), SEEN)
    assert swollen(splats, hidden).tolist() == [False] * 3 + [True, False, True] + [False] * 3, "the street, a car, its shade"
    assert not swollen(splats, known).any()


def splats_of(groups: list[list[float]], colour) -> tuple[Splats, torch.Tensor]:
    """Groups of random splats in a unit cube with these parts shown, coloured `colour(part)`."""
    made = []
    for i, parts in enumerate(groups):
        cloud = random_splats(len(parts), i, sh_count=4)
        rgb = torch.tensor([colour(part) for part in parts])
        made.append(replace(cloud, sh=torch.cat([sh_from_rgb(rgb)[:, None], torch.full((len(parts), 3, 3), 0.1)], 1)))
    return Splats.of(made, [torch.ones(len(g)) for g in groups]), torch.tensor([p for g in groups for p in g])


def test_hidden_splats_take_the_colours_of_known_ones_beside_them():
    grey, orange = [0.4, 0.4, 0.4], [1.0, 0.5, 0.0]
    groups = [[0.5] * 40 + [0.01] * 10 + [0.0] * 5, [0.9] * (NEIGHBOURS - 1) + [0.01] * 4]
    splats, part = splats_of(groups, lambda p: grey if p >= SEEN else orange)
    before = splats.fields["sh"].clone()
    guessed = as_neighbours(splats, part, part > 0, DEEP)
    assert guessed.nonzero()[:, 0].tolist() == list(range(40, 50)), "not what no picture pulls at, nor an actor of which nothing is known"
    after = splats.fields["sh"]
    assert torch.equal(after[~guessed], before[~guessed])
    torch.testing.assert_close(after[40:50, :1], before[:1, :1].expand(10, -1, -1))
    assert not after[40:50, 1:].any(), "which are the same from everywhere"
    assert as_neighbours(splats, part, part >= 0, DEEP)[50:55].all(), "pulled at, by a rim at a border: its middle is in no picture"


def test_the_nearest_count_most():
    splats, part = splats_of([[1.0] * 60 + [0.01]], lambda p: [0.2, 0.2, 0.2])
    means, sh = splats.fields["means"], splats.fields["sh"]
    means[:20], means[20:60], means[60] = torch.rand(20, 3) * 0.1, 3 + torch.rand(40, 3), torch.zeros(3)
    sh[20:60] += 1.0
    splats.fields["log_scales"][60] = math.log(0.05)
    as_neighbours(splats, part, part > 0, DEEP)
    torch.testing.assert_close(sh[60, 0], sh[0, 0])


def test_the_street_beside_a_parked_car_takes_the_streets_colour_pulled_at_or_not():
    """Blue splats are nearer, and higher; one that stands there and is hidden takes theirs. Nearer ones of the street, many
    on one spot, are black."""
    flat = Ground(torch.zeros(21, 21), (-10.0, -10.0), 1.0)
    splats, part = splats_of([[1.0] * 80 + [0.0] * 3], lambda p: [0.3, 0.3, 0.3])
    means, sh = splats.fields["means"], splats.fields["sh"]
    generator = torch.Generator().manual_seed(0)
    means[:40] = torch.cat([3 + torch.rand(40, 2, generator=generator), 0.02 * torch.rand(40, 1, generator=generator)], 1)
    means[:30, :2], sh[:30, 0] = 1.1 + 0.1 * (means[:30, :2] - 3), sh_from_rgb(torch.zeros(3))
    means[30:40, :2] = 3 + 4 * (means[30:40, :2] - 3)
    means[40:80] = torch.rand(40, 3, generator=generator) * 0.2 + torch.tensor([0.0, 0.0, 0.15])
    sh[40:80, 0] = sh_from_rgb(torch.tensor([0.1, 0.1, 0.8]))
    means[80:] = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.12], [0.1, 0.1, 0.5]])
    pulled = torch.ones(83, dtype=torch.bool)
    pulled[80] = False
    guessed = as_neighbours(splats, part, pulled, flat)
    assert guessed.nonzero()[:, 0].tolist() == [80, 81, 82]
    torch.testing.assert_close(sh[80:82, 0], sh[30:32, 0])
    torch.testing.assert_close(sh[82, 0], sh[40, 0])


def test_a_wall_that_no_picture_shows_takes_the_colour_of_another_not_of_the_road_before_it():
    flat = Ground(torch.zeros(21, 21), (-10.0, -10.0), 1.0)
    splats, part = splats_of([[1.0] * 60 + [0.0]], lambda p: [0.3, 0.3, 0.3])
    means, sh = splats.fields["means"], splats.fields["sh"]
    generator = torch.Generator().manual_seed(0)
    means[:40] = torch.cat([torch.rand(40, 2, generator=generator), torch.zeros(40, 1)], 1)
    means[40:60] = torch.rand(20, 3, generator=generator) + torch.tensor([5.0, 0.0, 0.5])
    sh[40:60, 0] = sh_from_rgb(torch.tensor([0.7, 0.2, 0.1]))
    means[60] = torch.tensor([0.5, 0.5, 0.5])
    assert as_neighbours(splats, part, part >= 0, flat).nonzero()[:, 0].tolist() == [60]
    torch.testing.assert_close(sh[60, 0], sh[40, 0])
    part[40 + NEIGHBOURS - 1 :] = 0.0
    as_neighbours(splats, part, part >= 0, flat)
    assert (sh[60, 0] < sh[40, 0]).any(), "of too few, all that is known"


def test_a_fit_keeps_them_to_its_end(drive):
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    while fit.population.guessed is None:
        fit.step()
    assert fit.progress == pytest.approx(GUESSED_FROM, abs=1.5 / CONFIG.steps)
    some = fit.population.guessed
    assert 0 < some.float().mean() < 0.7  # half of so small a scene is street that no picture shows
    before, of_movers = {name: field.clone() for name, field in fit.splats.fields.items()}, fit.splats.group_of() > 0
    assert (some & of_movers).sum() > 10
    while fit.step_count < CONFIG.steps:
        fit.step()
    after = fit.splats.fields
    assert torch.equal(after["sh"][some], before["sh"][some]), "their colours rest"
    for name in ("means", "quats", "log_scales", "logits"):
        assert torch.equal(after[name][some & of_movers], before[name][some & of_movers]), "and movers' altogether"
    street, known = some & ~of_movers, ~some
    assert not torch.equal(after["sh"][known], before["sh"][known]) and not torch.equal(after["means"][street], before["means"][street])
