"""The sides of a vehicle that pictures show from one end alone are its outline drawn along its length."""

import numpy as np
import pytest
import torch

from recon.fit.flanks import BONNET, INSET, LOGIT, OPEN, flanks
from scenes.gaussians import Gaussians
from scenes.harmonics import rgb_from_sh, sh_from_rgb

BOX = np.array([4.5, 2.0, 1.6])
PAINT, GLASS, LAMP = 0.9, 0.1, (0.8, 0.0, 0.0)
SILL = 1.0
"""Metres at which glass begins."""


def solid(points, rgb) -> Gaussians:
    points = np.asarray(points, dtype=np.float32)
    n = len(points)
    sh = torch.zeros(n, 4, 3)
    sh[:, 0] = sh_from_rgb(torch.as_tensor(np.broadcast_to(rgb, (n, 3)).copy()).float())
    scales = torch.tensor([0.04, 0.04, 0.04]).log().repeat(n, 1)
    return Gaussians(torch.from_numpy(points), torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), scales, torch.full((n,), 2.0), sh)


def an_end(x: float) -> Gaussians:
    """A rear or front at `x`: 1.8 m wide, paint below glass, each lamp of many splats."""
    y, z = (v.ravel() for v in np.meshgrid(np.arange(-0.9, 0.91, 0.06), np.arange(0.3, 1.55, 0.05)))
    body = np.stack([np.full(len(y), x), y, z], 1)
    lamps = [[x, side * (0.7 + 0.2 * i / 19), 0.7 + 0.2 * k / 19] for side in (-1, 1) for i in range(20) for k in range(20)]
    return Gaussians.cat([solid(body, np.where(z < SILL, PAINT, GLASS)[:, None]), solid(lamps, LAMP)])


def a_side(y: float, x=(-2.2, 2.2)) -> Gaussians:
    along, up = (v.ravel() for v in np.meshgrid(np.arange(*x, 0.08), np.arange(0.2, 1.6, 0.08)))
    return solid(np.stack([along, np.full(len(along), y), up], 1), 0.5)


@pytest.mark.parametrize("end", [1.0, -1.0])
def test_an_end_is_drawn_along_both_sides_in_its_paint_and_glass(end):
    made = flanks(an_end(2.2 * end), BOX, "van")
    at, rgb = made.means.numpy(), rgb_from_sh(made.sh[:, 0]).numpy()
    assert (np.abs(np.abs(at[:, 1]) - (0.88 - INSET)) < 0.05).all() and (at[:, 1] > 0).mean() == 0.5
    for low, high in ((0.3, 0.5), (0.7, 0.9), (1.3, 1.5)):
        row = at[(at[:, 2] >= low) & (at[:, 2] <= high)]
        assert row[:, 0].min() < -1.8 and row[:, 0].max() > 1.8, "from end to end, at each height"
    assert np.abs(rgb[at[:, 2] < SILL - 0.1] - PAINT).max() < 0.01, "lamps do not go round the corner"
    assert np.abs(rgb[at[:, 2] > SILL + 0.1] - GLASS).max() < 0.01
    assert (made.logit_opacities == LOGIT).all() and not made.sh[:, 1:].any()


@pytest.mark.parametrize(("label", "end", "bonnet"), [("car", -1, True), ("car", 1, False), ("truck", -1, False)])
def test_a_car_seen_from_behind_ends_in_a_bonnet(label, end, bonnet):
    at = flanks(an_end(2.2 * end), BOX, label).means.numpy()
    farthest = [(-end * at[(at[:, 2] > low) & (at[:, 2] < high), 0]).max() for low, high in ((0.75, 0.9), (1.35, 1.6))]
    assert farthest[0] > 1.8, "up to where a bonnet begins"
    assert farthest[1] < BONNET[1][0] * BOX[0] if bonnet else farthest[1] > 1.8


def test_where_an_end_is_not_known_a_side_has_the_colour_above_or_below_whatever_stands_within():
    end = an_end(-2.2)
    end = end.select((end.means[:, 2] < 0.6) | (end.means[:, 2] > SILL + 0.05))  # neither paint nor lamps between
    within = solid(np.random.default_rng(0).uniform([-0.5, -0.3, 0.6], [0.5, 0.3, 1.1], (200, 3)), 0.5)
    made = flanks(Gaussians.cat([end, within]), BOX, "van")
    rgb = rgb_from_sh(made.sh[(made.means[:, 2] > 0.75) & (made.means[:, 2] < 0.95), 0])
    assert len(rgb) and bool(((rgb - PAINT).abs() < 0.01).logical_or((rgb - GLASS).abs() < 0.01).all())


def test_a_side_that_is_known_is_left_and_one_that_is_not_is_made():
    left = Gaussians.cat([an_end(-2.2), a_side(0.9)])
    at = flanks(left, BOX, "van").means
    assert len(at) and (at[:, 1] < 0).all()
    assert len(flanks(Gaussians.cat([left, a_side(-0.9)]), BOX, "van")) == 0
    gap = Gaussians.cat([left, a_side(-0.9, (-2.2, 2.2 - 0.8 * OPEN * 4.4))])
    assert len(flanks(gap, BOX, "van")) == 0, "a hole in a side is none that nobody saw"


def test_what_is_known_within_a_vehicle_is_no_side_of_it():
    inside = solid(np.random.default_rng(0).uniform([-2, -0.3, 0.3], [2, 0.3, 1.5], (3000, 3)), 0.2)
    assert len(flanks(Gaussians.cat([an_end(-2.2), inside]), BOX, "van")) == len(flanks(an_end(-2.2), BOX, "van")) > 100


def test_what_pictures_show_deep_within_an_end_hides_no_side():
    """Of a picture's rear, seen from behind alone, many splats lie deeper than its surface, a metre or so."""
    deep = solid(np.random.default_rng(0).uniform([-2.1, -0.6, 0.3], [-1.2, 0.6, 1.5], (600, 3)), 0.2)
    at = flanks(Gaussians.cat([an_end(-2.2), deep]), BOX, "van").means
    assert len(at) > 0.9 * len(flanks(an_end(-2.2), BOX, "van")) and float(at[:, 0].min()) < -1.8


def test_specks_are_no_side_and_a_side_is_made_around_what_is_whole():
    specks = solid([[x, 0.85, z] for x in np.arange(-2, 2, 0.3) for z in np.arange(0.3, 1.5, 0.3)], 0.2)
    assert len(flanks(Gaussians.cat([an_end(-2.2), specks]), BOX, "van")) > 0.9 * len(flanks(an_end(-2.2), BOX, "van"))
    at = flanks(Gaussians.cat([an_end(-2.2), a_side(0.9, (-2.2, 0.0))]), BOX, "van").means
    left, right = at[at[:, 1] > 0], at[at[:, 1] < 0]
    assert len(left) and float(left[:, 0].min()) > -0.2, "where nothing stands yet"
    assert float(right[:, 0].min()) < -1.8


def test_of_little_or_nothing_no_side_is_made():
    end = an_end(-2.2)
    for known in (Gaussians.empty(4), end.select(torch.arange(30))):
        assert len(flanks(known, BOX, "car")) == 0


def test_of_a_long_one_whose_middle_alone_is_known_no_side_is_made():
    size, middle = np.array([12.0, 2.5, 3.2]), a_side(0.9, (-3.0, 3.0))
    for known in (middle, Gaussians.cat([middle, solid([[5.8, 0.9, 1.0]], 0.3)])):
        assert len(flanks(known, size, "truck")) == 0


@pytest.mark.parametrize("label", ["car", "van"])
def test_sides_end_where_the_vehicle_does(label):
    made = flanks(an_end(-2.2), BOX, label)
    reach = made.means[:, 0].abs() + made.log_scales[:, 0].exp()
    assert float(reach.max()) < BOX[0] / 2 + 0.05
