"""What a mover keeps from the ground goes along with it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from quick_fit import CONFIG, SIZE

from recon import open_log
from recon.assets.cleaning import lies_on_road
from recon.begin import begin
from recon.defaults import choose
from recon.fit.densify import shade_of
from recon.fit.model import Splats
from recon.log import Track
from recon.objects.tracks import LIMBED
from recon.seeds.shade import ABOVE, BESIDE, shade
from render import rasterize
from scenes.asset import Asset
from scenes.camera import Camera
from scenes.gaussians import Gaussians, Placed
from scenes.ground import Ground
from scenes.harmonics import sh_from_rgb
from scenes.lenses import Pinhole
from scenes.poses import translation
from scenes.shade import has_shade

FLAT = Ground(torch.full((41, 41), 2.0), (-20.0, -20.0), 1.0)


def driving(metres: float) -> Track:
    """A car whose box hovers so high above the ground, but for one box that was drawn a metre too low."""
    poses = torch.stack([translation(x, 1.0, 2.0 + metres) for x in (0.0, 2.0, 4.0)] + [translation(6.0, 1.0, 1.0 + metres)])
    times = np.arange(4) * 100_000
    return Track("veh_1", "car", True, np.array([4.0, 2.0, 1.5]), times, poses, np.full(4, -1), ())


def test_it_lies_on_the_ground_under_the_box_and_beside_it():
    made = shade(driving(0.3), FLAT, 4)
    assert made.means[:, 2].numpy() == pytest.approx(ABOVE - 0.3, abs=1e-5), "where most boxes have the ground"
    assert made.means[:, :2].abs().amax(0).tolist() == pytest.approx([2.0 + BESIDE, 1.0 + BESIDE])
    assert made.sh.shape[1] == 4 and torch.sigmoid(made.logit_opacities).max() < 0.15


def test_an_asset_brings_it_where_it_lies_beside_the_box_and_not_by_being_black():
    """Else a black car that is put in elsewhere would cast no shadow."""
    laid, size = shade(driving(0.0), FLAT, 1), torch.tensor([4.0, 2.0, 1.5])
    assert has_shade(Asset(laid, size, "car"))
    across = laid.select(laid.means[:, 0].abs() < 2)
    assert has_shade(Asset(across, size, "car")), "at its corners it may have faded"
    assert not has_shade(Asset(replace(laid, means=laid.means / 3 * torch.tensor([1.0, 1.0, 0.0])), size, "car"))


def test_it_is_road_where_an_asset_is_cut_out():
    assert lies_on_road(shade(driving(0.0), FLAT, 1)).all()


def test_it_darkens_a_road_evenly_from_above():
    x, y = np.meshgrid(np.arange(-8, 8, 0.2), np.arange(-8, 8, 0.2))
    n = x.size
    means = torch.from_numpy(np.stack([x.ravel(), y.ravel(), np.zeros(n)], 1)).float()
    quats, scales = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), torch.tensor([0.15, 0.15, 0.005]).log().repeat(n, 1)
    road = Gaussians(means, quats, scales, torch.full((n,), 4.0), torch.full((n, 1, 3), sh_from_rgb(0.6)))
    down = translation(0.0, 0.0, 8.0)
    down[:3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    above = Camera(Pinhole(80.0, 80.0, 48.0, 48.0), 96, 96, down)
    below = Placed(road, torch.eye(4, dtype=torch.float64))
    lit = rasterize([below], above, ("rgb",)).rgb
    shaded = rasterize([below, Placed(shade(driving(0.0), FLAT, 1), torch.eye(4, dtype=torch.float64), instance=1)], above, ("rgb",)).rgb
    under = (shaded / lit)[43:53, 33:63]
    assert float(under.min()) > 0.6 and float(under.max()) < 0.93, "of all of it as much"
    assert torch.equal(shaded[0], lit[0])


def test_vehicles_take_it_along_from_the_start(drive):
    log = open_log(drive)
    names, span = choose(log)
    start, _ = begin(log, names, span, SIZE, CONFIG, 4)
    vehicles = [i for i, t in enumerate(start.tracks) if t.label not in LIMBED]
    assert vehicles
    for i in vehicles:
        group = start.splats.groups(1)[1 + i]
        half = torch.from_numpy(start.tracks[i].size[:2]).float() / 2
        beside = (group.means[:, :2].abs() > half + 0.5).any(1)
        assert beside.sum() > 10 and group.means[beside, 2].abs().max() < 0.15


def test_it_lies_as_it_was_laid(drive):
    """Only how dark it is is fitted: what stands up beside a car, or is red as the lights behind it, would pass for what is there."""
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    which = shade_of(fit.splats).nonzero()[:, 0]
    before = {name: field[which].clone() for name, field in fit.splats.fields.items()}
    for _ in range(5):
        fit.step()
    after = {name: field[which] for name, field in fit.splats.fields.items()}
    assert len(which) > 20
    assert torch.equal(before["means"], after["means"]) and torch.equal(before["quats"], after["quats"])
    assert torch.equal(before["log_scales"][:, :2], after["log_scales"][:, :2]), "its thickness is what cameras can tell, at least"
    assert torch.equal(before["sh"], after["sh"]), "black, as it was laid"
    assert not torch.equal(before["logits"], after["logits"])


def test_movers_close_no_gap_that_is_seen_from_aside(drive, monkeypatch):
    """Hidden behind another car shade would grow dense to close the road there, a dark mat, and a car's splats would stretch over it; and
    what a walker's limbs and boxes' corrections would do for it no picture asks for."""
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    asked, gaps = [], fit.openings.gaps

    def alone(alpha, camera):
        poses = fit.motion.parameters(("actors",))
        fields = [shown[-1].fields[name] for name in ("means", "quats", "log_scales", "logits")]
        asked.append(torch.autograd.grad(gaps(alpha, camera), [*fields, *poses], retain_graph=True, allow_unused=True))
        return gaps(alpha, camera)

    shown, select = [], Splats.select
    monkeypatch.setattr(Splats, "select", lambda self, *which: shown.append(select(self, *which)) or shown[-1])
    monkeypatch.setattr(fit.openings, "gaps", alone)
    fit.step()
    movers = shown[-1].group_of() > 0
    assert shade_of(shown[-1])[movers].sum() > 20 and movers.sum() > 100
    for field in asked[0][:4]:
        assert field[~movers].any() and not field[movers].any()
    assert len(asked[0]) > 4 and all(pose is None or not pose.any() for pose in asked[0][4:])
