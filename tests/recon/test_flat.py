"""Splats on the ground become flat and lie along it; all others are left alone."""

import torch
from randomized import gaussians

from recon import open_log
from recon.build import begin, choose
from recon.fit.flat import ON, PRESSED, FlatGround
from recon.fit.model import Splats
from scenes.ground import Ground
from scenes.poses import matrix_from_quat
from tests.recon.test_fit import CONFIG, SIZE

SLOPE = (0.1, -0.05)
UP = torch.nn.functional.normalize(torch.tensor([-SLOPE[0], -SLOPE[1], 1.0]), dim=0)


def hillside() -> Ground:
    y, x = torch.meshgrid(torch.arange(0, 11.0), torch.arange(0, 21.0), indexing="ij")
    return Ground(2 + SLOPE[0] * (x - 10) + SLOPE[1] * (y - 5), (-10.0, -5.0), 1.0)


def lying(count=60, height=0.0) -> Splats:
    """Splats within the hillside, `height` metres over it, of which those of the second half are an actor's."""
    g, generator = gaussians(count), torch.Generator().manual_seed(1)
    place = (torch.rand(count, 2, generator=generator) - 0.5) * torch.tensor([18.0, 8.0])
    ground = hillside().height(place).float()
    g.means.copy_(torch.cat([place, (ground + height)[:, None]], 1))
    g.log_scales.copy_(torch.tensor([-4.5, -2.0, -3.2]) + torch.randn(count, 1, generator=generator))
    g.quats.mul_(1.7)
    half = count // 2
    first, second = (g.select(torch.arange(count)[part]) for part in (slice(0, half), slice(half, None)))
    return Splats.of([first, second], [torch.ones(half), torch.ones(count - half)])


def covariance(splats: Splats) -> torch.Tensor:
    axes = matrix_from_quat(splats.fields["quats"].double()) * splats.fields["log_scales"].double().exp()[:, None]
    return axes @ axes.transpose(1, 2)


def test_covariances_are_squeezed_along_the_normal():
    splats = lying()
    before = covariance(splats)
    FlatGround(hillside(), torch.device("cpu")).press(splats, torch.arange(60), 0.1)
    squeeze = torch.eye(3, dtype=torch.float64) - 0.1 * PRESSED * torch.outer(UP, UP).double()
    meant = squeeze @ before @ squeeze
    change, off = (meant - before)[:30].norm(dim=(1, 2)), (covariance(splats) - meant)[:30].norm(dim=(1, 2))
    assert (off < 0.03 * change).all()  # of axes of nearly one length it would be more: there the turn is damped
    assert torch.equal(covariance(splats)[30:], before[30:])  # an actor is no ground


def test_what_is_pressed_for_long_lies_flat_along_the_slope():
    splats = lying()
    wide = covariance(splats)[:30].diagonal(dim1=1, dim2=2).sum(1).sqrt()
    ground = FlatGround(hillside(), torch.device("cpu"))
    for _ in range(700):
        ground.press(splats, torch.arange(30), 1.0)
    after = covariance(splats)[:30]
    thick = torch.einsum("nij,i,j->n", after, UP.double(), UP.double()).sqrt()
    assert (thick < 0.02 * wide).all()
    assert (after.diagonal(dim1=1, dim2=2).sum(1).sqrt() > 0.3 * wide).all()  # along the ground they stay as wide as they were
    assert (matrix_from_quat(splats.fields["quats"])[:30].transpose(1, 2) @ UP).abs().amax(1).min() > 0.99


def test_only_what_lies_on_the_ground_and_is_shown_is_pressed():
    for height, pressed in ((0.9 * ON, True), (-0.9 * ON, True), (1.1 * ON, False), (-1.1 * ON, False)):
        splats = lying(height=height)
        before = covariance(splats)
        FlatGround(hillside(), torch.device("cpu")).press(splats, torch.arange(0, 60, 2), 1.0)
        changed = (covariance(splats) != before).any(dim=(1, 2))
        assert changed[0:30:2].all() == pressed and not changed[1::2].any() and not changed[30:].any()


def test_beyond_the_ground_its_rim_goes_on():
    splats = lying()
    at = splats.fields["means"]
    at[:, 0] += 40
    at[:, 2] = hillside().height(at[:, :2]).float()
    before = covariance(splats)
    FlatGround(hillside(), torch.device("cpu")).press(splats, torch.arange(60), 1.0)
    after = covariance(splats)
    assert (after[:30] != before[:30]).any(dim=(1, 2)).all() and after.isfinite().all()


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
        on &= fit.descent.last[: len(on)] > 0  # seen at all
        return covariance(fit.splats)[: len(on)][on][:, 2, 2].sqrt().median()

    pressed = thickness()
    monkeypatch.setattr("recon.fit.flat.PRESSED", 0.0)
    assert pressed < 0.9 * thickness()
