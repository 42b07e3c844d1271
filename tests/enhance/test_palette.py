"""Palettes of regions."""

import torch

from enhance.net import colour_change
from enhance.palette import RegionColour, palette


def test_a_palette_does_not_depend_on_where_colours_are():
    rgb, weight = torch.rand(1, 3, 50), torch.rand(1, 1, 50)
    order = torch.randperm(50)
    assert torch.allclose(palette(rgb, weight), palette(rgb[..., order], weight[..., order]), atol=1e-5)


def test_a_palette_is_of_the_weighted_colours_only():
    rgb, weight = torch.rand(1, 3, 50), torch.zeros(1, 1, 50)
    weight[..., :20] = 0.7
    alone = palette(rgb[..., :20], torch.ones(1, 1, 20))
    assert torch.allclose(palette(rgb, weight), alone, atol=1e-5)
    assert torch.isfinite(palette(rgb, torch.zeros_like(weight))).all()


def test_histograms_sum_to_one_and_means_are_means():
    rgb = torch.rand(2, 3, 40)
    found = palette(rgb, torch.ones(2, 1, 40))
    assert found.shape == (2, 48)
    assert torch.allclose(found[:, :36].reshape(2, 4, 9).sum(-1), torch.ones(2, 4), atol=1e-5)
    assert torch.allclose(found[:, 36:39], rgb.mean(-1), atol=1e-5)


def test_a_new_region_colour_changes_nothing():
    rgb = torch.rand(1, 3, 33, 18)
    assert torch.equal(RegionColour()(rgb, torch.rand(1, 1, 33, 18)), torch.zeros(1, 12))


def test_region_colour_learns_to_undo_an_exposure_from_its_surroundings():
    """A grey world of random brightness in which the region is half as bright: nothing but the comparison tells by how much."""
    torch.manual_seed(0)
    net = RegionColour()
    optimiser = torch.optim.Adam(net.parameters(), 1e-3)
    region = torch.zeros(16, 1, 16, 16)
    region[..., :8, :] = 1
    for _ in range(250):
        scene = (torch.rand(16, 1, 1, 1) * 0.6 + 0.3).expand(16, 3, 16, 16)
        seen = scene * (1 - 0.5 * region)
        better = seen + region * colour_change(seen, net(seen, region)[:, :, None, None])
        loss = (better - scene).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert loss < 0.25 * (seen - scene).abs().mean()
