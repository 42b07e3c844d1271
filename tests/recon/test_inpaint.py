import pytest
import torch
from quick_fit import SIZE

from recon import open_log
from recon.begin import begin
from recon.defaults import choose
from recon.fit import inpaint
from recon.fit.config import FitConfig
from recon.fit.inpaint import AMONG, NEAR, background, inpainted
from recon.fit.unseen import LOW, SEEN, off_ground
from scenes import Gaussians
from scenes.harmonics import sh_from_rgb


def wall(x, z, size, rgb, degree=4):
    """Splats in the plane y = 0, flat in it."""
    n = len(x)
    sh = torch.zeros(n, degree, 3)
    sh[:, :1] = sh_from_rgb(torch.tensor(rgb).expand(n, 3))[:, None]
    sh[:, 1:] = 0.1
    scales = torch.tensor([size, 0.1 * size, size]).expand(n, 3)
    return Gaussians(
        torch.stack([x, torch.zeros(n), z], 1), torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4), scales.log(), torch.full((n,), 2.0), sh
    )


def half_hidden():
    """A wall of small splats, white above and red below, and behind what hides it two large grey ones, one beside each colour."""
    grid = torch.meshgrid(torch.arange(-2.0, 0.0, 0.1), torch.arange(0.0, 2.0, 0.1), indexing="ij")
    x, z = (t.reshape(-1) for t in grid)
    low = wall(x[z < 1], z[z < 1], 0.05, (0.8, 0.1, 0.1))
    high = wall(x[z >= 1], z[z >= 1], 0.05, (0.9, 0.9, 0.9))
    large = wall(torch.tensor([0.4, 0.4]), torch.tensor([0.3, 1.7]), 0.3, (0.5, 0.5, 0.5))
    whole = Gaussians.cat([low, high, large])
    hidden = torch.arange(len(whole)) >= len(whole) - 2
    return whole, hidden


def test_what_pictures_do_not_show_goes_on_like_what_is_beside_it():
    whole, hidden = half_hidden()
    filled = inpainted(whole, hidden, ~hidden, 0)
    copies = filled.select(torch.arange(len(whole) - 2, len(filled)))
    assert torch.equal(filled.means[: len(whole) - 2], whole.means[:-2]), "what is known stays"
    assert len(copies) > 20 and torch.allclose(copies.log_scales.exp().amax(1), torch.tensor(0.05))
    assert torch.equal(copies.logit_opacities, torch.full((len(copies),), 2.0))
    assert (copies.means[:, 0] - 0.4).abs().max() < 0.6 and copies.means[:, 1].abs().max() < 0.06
    red = copies.sh[:, 0, 1] < 0
    assert red[copies.means[:, 2] < 0.6].all() and not red[copies.means[:, 2] > 1.4].any()
    assert not copies.sh[:, 1:].any(), "how others turn with the view says nothing of there"
    assert torch.equal(filled.means, inpainted(whole, hidden, ~hidden, 0).means)
    assert not torch.equal(filled.means, inpainted(whole, hidden, ~hidden, 1).means)


def test_as_fine_as_its_surroundings_or_far_from_all_that_is_known_it_stays():
    whole, hidden = half_hidden()
    fine = whole.log_scales.clone()
    fine[hidden] = torch.tensor([0.06, 0.006, 0.06]).log()
    as_fine = Gaussians(whole.means, whole.quats, fine, whole.logit_opacities, whole.sh)
    assert len(inpainted(as_fine, hidden, ~hidden, 0)) == len(whole)
    far = whole.means.clone()
    far[hidden, 0] += NEAR
    away = Gaussians(far, whole.quats, whole.log_scales, whole.logit_opacities, whole.sh)
    assert torch.equal(inpainted(away, hidden, ~hidden, 0).means, far)
    few = torch.arange(len(whole)) < AMONG
    for known in (few, torch.zeros_like(few)):
        assert len(inpainted(whole, hidden, known, 0)) == len(whole)


def test_only_a_finished_fit_is_filled_where_cameras_beside_the_path_look(drive, monkeypatch):
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, FitConfig(steps=20, budget=2000), 4)
    asked = []
    monkeypatch.setattr(inpaint, "inpainted", lambda splats, hidden, known, seed: asked.append((hidden, known)) or splats)
    mine = fit.splats.sizes[0]
    assert len(background(fit)) == mine and not asked
    fit.step_count = fit.config.steps
    eyes = []
    shown_by = fit.shown_by
    monkeypatch.setattr(fit, "shown_by", lambda shots: shown_by(eyes.append(s.camera.world_from_cam[:3, 3]) or s for s in shots))
    assert len(background(fit)) == mine
    ((hidden, known),) = asked
    assert hidden.shape == known.shape == (mine,) and hidden.any() and known.any() and not (hidden & known).any()
    assert (fit.shown().part[:mine][hidden] < SEEN).all()
    assert (off_ground(fit.splats, fit.population.ground)[:mine][hidden | known] > LOW).all()
    path = torch.stack([fit.motion.shot(v).camera.world_from_cam[:3, 3] for v in fit.training])
    away = (torch.stack(eyes)[:, None] - path).detach().norm(dim=2).amin(1)
    assert float(away.max()) == pytest.approx(3, abs=0.2) and int((away > 1).sum()) >= 4
