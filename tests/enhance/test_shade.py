"""The grid of a missing shadow."""

import torch

from enhance.shade import ACROSS, DOWN, KNOTS, optical_depth, shaded


def test_a_knot_has_its_own_depth_and_beyond_the_grid_is_none():
    depths = torch.rand(2, KNOTS)
    knots = torch.cartesian_prod(torch.tensor(DOWN[1:-1]), torch.tensor(ACROSS[1:-1])).expand(2, -1, -1)
    assert torch.allclose(optical_depth(knots, depths), depths, atol=1e-6)
    beyond = torch.tensor([[DOWN[0], 0.0], [DOWN[-1], 0.0], [1.0, ACROSS[0]], [1.0, ACROSS[-1]], [9.0, 9.0]]).expand(2, -1, -1)
    assert (optical_depth(beyond, depths) == 0).all()


def test_equal_depths_are_equal_between_the_knots():
    places = torch.rand(1, 50, 2) * torch.tensor([1.1, 3.0]) + torch.tensor([0.25, -1.5])
    assert torch.allclose(optical_depth(places, torch.full((1, KNOTS), 0.7)), torch.full((1, 50), 0.7), atol=1e-6)


def test_shade_halves_light_and_not_the_stored_value():
    white = torch.ones(1, 3)
    assert torch.allclose(shaded(white, torch.zeros(1)), white)
    assert abs(float(shaded(white, torch.tensor([0.6931]))[0, 0]) - 0.7354) < 1e-3


def test_black_ground_has_a_gradient():
    depth = torch.zeros(1, requires_grad=True)
    shaded(torch.zeros(1, 3), depth).sum().backward()
    assert torch.isfinite(depth.grad).all()
