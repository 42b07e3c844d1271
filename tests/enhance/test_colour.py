"""Colours that do not belong: thinning, fields, and learning to compare."""

import pytest
import torch

from enhance.colour import FIELDS, ColourNet, altered_logits, colour_change, thin


@pytest.mark.parametrize(
    ("size", "small"),
    [((360, 640), (90, 160)), ((540, 960), (90, 160)), ((1920, 1080), (160, 90)), ((16, 16), (16, 16)), ((17, 33), (16, 32))],
)
def test_thinning_keeps_proportions_and_whole_pixels(size, small):
    image = torch.rand(1, 3, *size)
    found = thin(image)
    assert found.shape[-2:] == small
    assert torch.isin(found[0, 0], image[0, 0]).all()
    assert torch.equal(found[..., 0, 0], image[..., 0, 0]) and torch.equal(found[..., -1, -1], image[..., -1, -1])


def test_a_new_colour_network_changes_nothing():
    rgb = torch.rand(2, 3, 34, 50)
    fields = ColourNet()(rgb, torch.zeros(2, 2, 34, 50))
    assert fields.shape == (2, FIELDS, 17, 25)
    assert torch.equal(colour_change(rgb, fields), torch.zeros_like(rgb))


def test_colour_fields_scale_saturate_and_offset():
    rgb = torch.rand(1, 3, 16, 16)
    fields = torch.zeros(1, FIELDS, 2, 2)
    fields[:, 3:6] = -0.25
    assert torch.allclose(colour_change(rgb, fields), -0.25 * rgb, atol=1e-6)
    fields = torch.zeros(1, FIELDS, 2, 2)
    fields[:, 9:12] = 1
    grey = rgb + colour_change(rgb, fields)
    assert torch.allclose(grey, grey[:, :1].expand_as(grey), atol=1e-6)


def test_it_learns_to_undo_an_exposure_from_its_surroundings():
    """A grey world of random brightness in which half is darker: nothing but the comparison tells by how much, and where."""
    torch.manual_seed(0)
    net = ColourNet(8, 16, 16)
    optimiser = torch.optim.Adam(net.parameters(), 2e-3)
    region = torch.zeros(16, 1, 16, 16)
    region[:8, :, :8] = 1
    region[8:, :, :, 8:] = 1
    for _ in range(250):
        scene = (torch.rand(16, 1, 1, 1) * 0.6 + 0.3).expand(16, 3, 16, 16)
        seen = scene * (1 - 0.5 * region)
        fields = net(seen, torch.zeros(16, 2, 16, 16))
        logits = altered_logits(fields, (16, 16))
        better = seen + torch.sigmoid(logits) * colour_change(seen, fields)
        loss = (better - scene).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert loss < 0.35 * (seen - scene).abs().mean()
