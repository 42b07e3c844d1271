"""Moving images by flow."""

import math

import pytest
import torch

from render.warp import visible, warp


def constant_flow(x, y, h=10, w=14):
    return torch.tensor([x, y], dtype=torch.float32)[None, :, None, None].repeat(1, 1, h, w)


def test_whole_pixel_flow_moves_exactly():
    previous = torch.rand(1, 2, 10, 14)
    moved, inside = warp(previous, constant_flow(3, -1))
    assert torch.allclose(moved[..., 1:, :-3], previous[..., :-1, 3:], atol=1e-6)
    assert inside[..., 0, :].sum() == 0 and inside[..., -3:].sum() == 0 and inside[..., 1:, :-3].min() == 1


def test_zero_flow_changes_nothing():
    previous = torch.rand(2, 3, 9, 7)
    moved, inside = warp(previous, torch.zeros(2, 2, 9, 7))
    assert torch.allclose(moved, previous, atol=1e-6) and inside.min() == 1


@pytest.mark.parametrize("unknown", [math.nan, math.inf, -math.inf])
def test_unknown_flow_spreads_nothing(unknown):
    flow = constant_flow(0, 0)
    flow[..., 4, 5] = unknown
    moved, inside = warp(torch.ones(1, 1, 10, 14), flow)
    assert torch.isfinite(moved).all() and inside[0, 0, 4, 5] == 0 and moved[0, 0, 4, 5] == 0 and inside.sum() == 139


def test_points_that_return_are_visible_and_others_are_not():
    there, back = constant_flow(2, 0), constant_flow(-2, 0)
    seen = visible(there, back)[0, 0]
    assert seen[:, :-2].all() and not seen[:, -2:].any()
    assert not visible(there, constant_flow(3, 0)).any()
    back[..., 5, 5] = torch.nan
    assert not visible(there, back)[0, 0, 5, 3]
