"""Splats on the ground become flat and lie along it; all others are left alone."""

import numpy as np
import pytest
import torch
from quick_fit import CONFIG, SIZE
from randomized import gaussians

from recon import open_log
from recon.begin import begin
from recon.defaults import choose
from recon.fit.descent import COLOURS, Descent, rates_at
from recon.fit.flat import LEVELLED, ON, OVER, PRESSED, THIN, UNDER, FlatGround
from recon.fit.model import Splats
from recon.ground import BARE, GROUND
from scenes.ground import Ground
from scenes.poses import matrix_from_quat

SLOPE = (0.1, -0.05)
UP = torch.nn.functional.normalize(torch.tensor([-SLOPE[0], -SLOPE[1], 1.0]), dim=0)
NOW = 7
EYE = torch.tensor([-25.0, 1.0, 4.0], dtype=torch.float64)


def ground_of(height) -> Ground:
    """40 x 30 m of heights `height(x, y)`, the origin in their middle."""
    y, x = torch.meshgrid(torch.arange(-15, 16.0), torch.arange(-20, 21.0), indexing="ij")
    return Ground(height(x, y), (-20.0, -15.0), 1.0)


def hillside() -> Ground:
    return ground_of(lambda x, y: 2 + SLOPE[0] * x + SLOPE[1] * y)


def lying(on: Ground, count=60, height=0.0) -> Splats:
    """Splats in the middle of a ground, `height` metres over it, of which those of the second half are an actor's."""
    g, generator = gaussians(count), torch.Generator().manual_seed(1)
    place = (torch.rand(count, 2, generator=generator) - 0.5) * torch.tensor([18.0, 8.0])
    g.means.copy_(torch.cat([place, (on.height(place).float() + height)[:, None]], 1))
    g.log_scales.copy_(torch.tensor([-6.5, -3.5, -4.7]) + 0.2 * torch.randn(count, 1, generator=generator))
    g.quats.mul_(1.7)
    half = count // 2
    first, second = (g.select(torch.arange(count)[part]) for part in (slice(0, half), slice(half, None)))
    return Splats.of([first, second], [torch.ones(half), torch.ones(count - half)])


def flat_on(ground: Ground, shown=0) -> FlatGround:
    return FlatGround(ground, torch.full(ground.heights.shape, shown, dtype=torch.uint8), torch.device("cpu"))


def pressed(splats: Splats, on: Ground, settle=1.0, times=1, moved=None, unseen=None, shown=0) -> None:
    descent, flat = Descent.begin(splats), flat_on(on, shown)
    descent.moments[:, 1, COLOURS:] = 1
    if unseen is not None:
        descent.moments[unseen, 1, COLOURS:] = 0
    descent.last[slice(None) if moved is None else moved] = NOW
    for _ in range(times):
        flat.press(splats, torch.arange(len(splats)), descent, rates_at(NOW, {}), settle, EYE)


def covariance(splats: Splats) -> torch.Tensor:
    axes = matrix_from_quat(splats.fields["quats"].double()) * splats.fields["log_scales"].double().exp()[:, None]
    return axes @ axes.transpose(1, 2)


def changed(splats: Splats, before: torch.Tensor) -> torch.Tensor:
    return (covariance(splats) != before).any(dim=(1, 2))


def test_covariances_are_squeezed_along_the_normal(monkeypatch):
    """But for the turn, which is faster."""
    monkeypatch.setattr("recon.fit.flat.LEVELLED", PRESSED)
    splats = lying(hillside())
    before = covariance(splats)
    pressed(splats, hillside(), 0.1)
    squeeze = torch.eye(3, dtype=torch.float64) - 0.1 * PRESSED * torch.outer(UP, UP).double()
    meant = squeeze @ before @ squeeze
    change, off = (meant - before)[:30].norm(dim=(1, 2)), (covariance(splats) - meant)[:30].norm(dim=(1, 2))
    assert (off < 0.03 * change).all()  # of axes of nearly one length it would be more: there the turn is damped
    assert torch.equal(covariance(splats)[30:], before[30:])  # an actor is no ground


def test_what_is_long_is_laid_down_without_becoming_shorter():
    """As along a line on the road, and climbing: of which a straight path tells nothing."""
    level = ground_of(lambda x, y: 0 * x)
    splats, tilt = lying(level), 0.2
    splats.fields["log_scales"][:] = torch.tensor([-1.5, -3.5, -6.0])
    splats.fields["quats"][:] = torch.tensor([np.cos(tilt / 2), 0, -np.sin(tilt / 2), 0])
    steps = round(1 / LEVELLED)
    pressed(splats, level, times=steps)
    along = matrix_from_quat(splats.fields["quats"])[:30, :, 0]
    assert along[:, 2].asin() == pytest.approx(tilt / np.e, rel=0.1)
    assert splats.fields["log_scales"][:30, 0] == pytest.approx(-1.5, abs=2 * steps * PRESSED * tilt**2)


def test_what_is_pressed_for_long_lies_flat_along_the_slope():
    splats = lying(hillside())
    wide = covariance(splats)[:30].diagonal(dim1=1, dim2=2).sum(1).sqrt()
    pressed(splats, hillside(), times=700)
    after = covariance(splats)[:30]
    thick = torch.einsum("nij,i,j->n", after, UP.double(), UP.double()).sqrt()
    assert (thick < 0.02 * wide).all()
    assert (after.diagonal(dim1=1, dim2=2).sum(1).sqrt() > 0.2 * wide).all()  # along the ground they stay as wide as they were
    assert (matrix_from_quat(splats.fields["quats"])[:30].transpose(1, 2) @ UP).abs().amax(1).min() > 0.99


@pytest.mark.parametrize(("height", "flat"), [(0.8 * ON, True), (-0.8 * ON, True), (1.2 * ON, False), (-1.2 * ON, False)])
def test_only_what_lies_on_the_ground_and_moved_is_pressed(height, flat):
    """On ground that is no plane."""
    bumpy = ground_of(lambda x, y: torch.sin(x) + torch.cos(0.7 * y) * x / 5)
    splats = lying(bumpy, height=height)
    before = covariance(splats)
    pressed(splats, bumpy, moved=torch.arange(0, 60, 2))
    now = changed(splats, before)
    assert (now[0:30:2].all() if flat else not now.any()) and not now[1::2].any() and not now[30:].any()


def test_what_stands_on_it_is_left_alone():
    """The foot of a wall: thin, but not across the ground."""
    splats = lying(hillside())
    splats.fields["log_scales"] += 2
    before = covariance(splats)
    upright = torch.einsum("nij,i,j->n", before, UP.double(), UP.double()).sqrt()[:30] > ON
    pressed(splats, hillside())
    assert upright.any() and not upright.all() and torch.equal(changed(splats, before)[:30], ~upright)


def test_a_kerb_is_no_ramp():
    kerb = ground_of(lambda x, y: 0.12 * (x > 0))
    splats = lying(kerb)
    pressed(splats, kerb, times=700)
    axes = matrix_from_quat(splats.fields["quats"])[:30, 2].abs().amax(1)
    assert axes.min() > 0.9985  # three degrees; from one height to the next it would be seven


def test_beyond_the_ground_nothing_is_pressed():
    splats = lying(hillside())
    at = splats.fields["means"]
    at[:, 0] += 40
    at[:, 2] = hillside().height(at[:, :2]).float()
    before = covariance(splats)
    pressed(splats, hillside())
    assert not changed(splats, before).any()


@pytest.mark.parametrize(("shown", "lowest", "highest"), [(0, -ON, ON), (GROUND, -UNDER, ON), (BARE, -UNDER, OVER)])
def test_where_the_ground_is_known_what_is_farther_off_lies_on_it_too(shown, lowest, highest):
    bumpy = ground_of(lambda x, y: torch.sin(x) + torch.cos(0.7 * y) * x / 5)
    for height in (-1.1 * UNDER, -0.9 * UNDER, -0.9 * ON, 0.9 * ON, 0.8 * OVER, 1.2 * OVER):
        splats = lying(bumpy, height=height)
        before = covariance(splats)
        pressed(splats, bumpy, shown=shown)
        assert changed(splats, before)[:30].tolist() == [lowest < height < highest] * 30, height


@pytest.mark.parametrize(("height", "shown"), [(0.05, 0), (-0.05, 0), (0.25, BARE), (-0.8, GROUND)])
def test_what_lies_off_the_ground_is_drawn_to_it_along_the_rays_to_the_eye(height, shown):
    splats = lying(hillside(), height=height)
    before = splats.fields["means"].clone()
    pressed(splats, hillside(), times=10, shown=shown)
    after = splats.fields["means"]
    off = after[:, 2] - hillside().height(after[:, :2]).float()
    assert (off[:30] * np.sign(height) < 0.95 * abs(height)).all() and torch.equal(after[30:], before[30:])
    ways = [torch.nn.functional.normalize(at - EYE.float(), dim=1) for at in (before, after)]
    torch.testing.assert_close(*ways, atol=1e-5, rtol=0)
    pressed(splats, hillside(), times=1500, shown=shown)
    at = splats.fields["means"][:30]
    torch.testing.assert_close(at[:, 2].double(), hillside().height(at[:, :2]), atol=0.001, rtol=0)


def test_a_robots_eye_draws_what_lies_on_its_floor_to_it_too():
    """It is 0.28 m above the floor, less than a car's camera ever is above what it looks down on."""
    floor = ground_of(lambda x, y: 0.0 * x)
    splats = lying(floor, height=0.05)
    descent = Descent.begin(splats)
    descent.moments[:, 1, COLOURS:], descent.last[:] = 1, NOW
    for _ in range(10):
        flat_on(floor).press(splats, torch.arange(60), descent, rates_at(NOW, {}), 1.0, torch.tensor([0.0, 0.0, 0.28], dtype=torch.float64))
    assert (splats.fields["means"][:30, 2] < 0.95 * 0.05).all()


def test_what_is_laid_onto_the_ground_is_thin_and_lies_along_it():
    splats = lying(hillside(), height=0.15)
    splats.fields["log_scales"] += 2
    before, wide = splats.fields["means"].clone(), covariance(splats)
    which = torch.arange(60) % 3 == 0
    flat_on(hillside()).lay(splats, which)
    at, after = splats.fields["means"], covariance(splats)
    assert torch.equal(at[~which], before[~which]) and torch.equal(after[~which], wide[~which])
    assert torch.equal(at[:, :2], before[:, :2]) and float((at[which, 2] - hillside().height(at[which, :2])).abs().max()) < 1e-5
    thick = torch.einsum("nij,i,j->n", after, UP.double(), UP.double()).sqrt()
    was = torch.einsum("nij,i,j->n", wide, UP.double(), UP.double()).sqrt()
    torch.testing.assert_close(thick[which], was[which].clamp_max(THIN), rtol=1e-3, atol=1e-6)
    along = torch.linalg.cross(UP, torch.tensor([0.0, 1.0, 0.0])).double()
    spans = [torch.einsum("nij,i,j->n", c, along, along)[which] for c in (wide, after)]
    torch.testing.assert_close(*spans, rtol=1e-3, atol=1e-8)


def test_what_no_picture_shows_is_no_fog_however_thick():
    splats = lying(hillside())
    splats.fields["log_scales"][:] = -1.5
    before = covariance(splats)
    pressed(splats, hillside(), times=40, unseen=torch.arange(0, 60, 2))
    after = covariance(splats)
    thick = torch.einsum("nij,i,j->n", after, UP.double(), UP.double()).sqrt()
    assert (thick[0:30:2] < 0.02).all() and torch.equal(after[1::2], before[1::2]) and torch.equal(after[30:], before[30:])
    assert (after[0:30:2].diagonal(dim1=1, dim2=2).sum(1).sqrt() > 0.25).all(), "along the ground it is as wide as it was"


def test_what_closes_a_gap_on_the_ground_stays_where_it_lies():
    splats = lying(hillside(), height=0.2)
    splats.fields["means"][:5, 2] += 1
    low = flat_on(hillside()).on(splats)
    assert low.tolist() == [False] * 5 + [True] * 25 + [False] * 30, "what stands, the street, an actor"
    shown = splats.select(torch.arange(60), 1)
    held = shown.held(low, ("means", "quats"))
    sum(field.square().sum() for field in held.fields.values()).backward()
    for name, field in shown.fields.items():
        moved = field.grad.reshape(60, -1).abs().sum(1) > 0
        assert moved[~low].all() and moved[low].any() == (name not in ("means", "quats")), name


def test_a_fit_presses_its_road(drive, monkeypatch):
    """As thick as it is after forty steps, against a fit that presses nothing."""
    log = open_log(drive)
    names, span = choose(log)

    def thickness() -> torch.Tensor:
        start, fit = begin(log, names, span, SIZE, CONFIG, 4)
        for _ in range(40):
            fit.step()
        means = fit.splats.fields["means"][: fit.splats.sizes[0]]
        on = (means[:, 2] - start.ground.height(means[:, :2])).abs() < ON
        on &= fit.population.descent.coloured()[: len(on)]  # seen by pictures, not from aside alone
        return covariance(fit.splats)[: len(on)][on][:, 2, 2].sqrt().median()

    flat = thickness()
    monkeypatch.setattr("recon.fit.flat.PRESSED", 0.0)
    assert flat < 0.9 * thickness()
