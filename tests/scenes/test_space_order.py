"""Splats in an order that follows space."""

import pytest
import torch

from scenes.space_order import space_order


@pytest.mark.parametrize("count", [0, 1, 2, 5000])
def test_every_point_comes_once(count):
    order = space_order(torch.randn(count, 3, generator=torch.Generator().manual_seed(1)))
    assert torch.equal(order.sort().values, torch.arange(count))


def test_runs_of_points_lie_close_together():
    points = torch.rand(8192, 3, generator=torch.Generator().manual_seed(2))

    def extent(p):
        runs = p.view(-1, 64, 3)
        return (runs.amax(1) - runs.amin(1)).norm(dim=1).mean()

    assert extent(points[space_order(points)]) < 0.4 * extent(points)


def test_points_on_one_spot_and_one_far_away_are_ordered():
    points = torch.zeros(100, 3)
    points[7] = 1e9
    assert len(space_order(points).unique()) == 100
