from dataclasses import replace

import pytest
import torch
from quick_fit import SIZE

from recon import open_log
from recon.begin import begin
from recon.defaults import choose
from recon.fit import inpaint
from recon.fit.config import FitConfig
from recon.fit.inpaint import AMONG, NEAR, background, by_example
from recon.fit.unseen import LOW, SEEN, off_ground
from scenes import Gaussians
from scenes.harmonics import sh_from_rgb

EMPTY = torch.zeros(0, dtype=torch.int64)


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
    copies, of = by_example(whole, hidden, ~hidden, 0)
    assert len(copies) == len(of) > 20 and set(of.tolist()) == set(hidden.nonzero()[:, 0].tolist())
    assert torch.allclose(copies.log_scales.exp().amax(1), torch.tensor(0.05))
    assert torch.equal(copies.logit_opacities, torch.full((len(copies),), 2.0))
    away = (copies.means - whole.means[of]).abs()
    assert away[:, ::2].max() < 0.5 and away[:, 1].max() < 0.05 and away[:, 0].max() > 0.3
    red = copies.sh[:, 0, 1] < 0
    assert red[copies.means[:, 2] < 0.6].all() and not red[copies.means[:, 2] > 1.4].any()
    assert not copies.sh[:, 1:].any(), "how others turn with the view says nothing of there"
    assert torch.equal(copies.means, by_example(whole, hidden, ~hidden, 0)[0].means)
    assert not torch.equal(copies.means, by_example(whole, hidden, ~hidden, 1)[0].means)


def test_what_is_unlike_all_around_it_is_no_example():
    """Every sixth splat of the wall is green: where it is the nearest, its copies would be dots in a row."""
    whole, hidden = half_hidden()
    odd = ~hidden & (torch.arange(len(whole)) % 6 == 0)
    sh = whole.sh.clone()
    sh[odd, 0] = sh_from_rgb(torch.tensor([0.0, 0.6, 0.0]))
    copies, _ = by_example(replace(whole, sh=sh), hidden, ~hidden, 0)
    assert len(copies) > 20 and not (copies.sh[:, 0] == sh[0, 0]).all(1).any()


def test_what_is_as_fine_as_its_surroundings_or_far_from_all_that_is_known_has_no_copies():
    whole, hidden = half_hidden()
    fine = whole.log_scales.clone()
    fine[hidden] = torch.tensor([0.06, 0.006, 0.06]).log()
    far = whole.means.clone()
    far[hidden, 0] += NEAR
    few = torch.arange(len(whole)) < AMONG
    for splats, known in (
        (replace(whole, log_scales=fine), ~hidden),
        (replace(whole, means=far), ~hidden),
        (whole, few),
        (whole, torch.zeros_like(few)),
    ):
        copies, of = by_example(splats, hidden, known, 0)
        assert len(copies) == len(of) == 0


@pytest.fixture
def fit(drive):
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, FitConfig(steps=20, budget=2000), 4)
    return fit


def test_only_a_finished_fit_is_filled_where_cameras_beside_the_path_look(fit, monkeypatch):
    asked, eyes, shown_by = [], [], fit.shown_by
    monkeypatch.setattr(
        inpaint, "by_example", lambda splats, hidden, known, seed: asked.append((hidden, known)) or (splats.select(EMPTY), EMPTY)
    )
    mine = fit.splats.sizes[0]
    assert len(background(fit)) == mine and not asked
    fit.step_count = fit.config.steps
    monkeypatch.setattr(
        fit, "shown_by", lambda shots, of=None: shown_by((eyes.append(s.camera.world_from_cam[:3, 3]) or s for s in shots), of)
    )
    assert len(background(fit)) == mine
    ((hidden, known),) = asked
    assert hidden.shape == known.shape == (mine,) and hidden.any() and known.any() and not (hidden & known).any()
    assert (fit.shown().part[:mine][hidden] < SEEN).all()
    assert (off_ground(fit.splats, fit.population.ground)[:mine][hidden | known] > LOW).all()
    path = torch.stack([fit.motion.shot(v).camera.world_from_cam[:3, 3] for v in fit.training])
    away = (torch.stack(eyes)[:, None] - path).norm(dim=2).amin(1).detach()
    assert float(away.max()) == pytest.approx(3, abs=0.2) and int((away > 1).sum()) >= 4


def test_copies_that_pictures_show_are_left_out(fit, monkeypatch):
    """Of three splats the first has copies where pictures look, the second where none does, the third most of them so."""
    fit.step_count = fit.config.steps
    splats = fit.splats.groups(1)[0].detach()
    part = fit.shown().part[: len(splats)]
    best, behind = int(part.argmax()), splats.means[part.argmax()] - torch.tensor([1000.0, 0, 0])

    def made(splats, hidden, known, seed):
        of = torch.tensor([5, 5, 5, 7, 7, 7, 9, 9, 9])
        seen = torch.tensor([1, 1, 0, 0, 0, 0, 1, 0, 0]) > 0
        copies = splats.select(torch.full((len(of),), best))
        return replace(copies, means=torch.where(seen[:, None], copies.means, behind)), of

    monkeypatch.setattr(inpaint, "by_example", made)
    filled = background(fit)
    assert len(filled) == len(splats) - 2 + 5
    assert torch.equal(filled.means[-5:], behind.expand(5, 3))
    left = {tuple(m) for m in filled.means.tolist()}
    assert [tuple(splats.means[i].tolist()) in left for i in (5, 7, 9)] == [True, False, False]
