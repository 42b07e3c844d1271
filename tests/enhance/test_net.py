"""The network by itself."""

import pytest
import torch
from small_net import SMALL, stirred

from enhance.autoencoder import Autoencoder
from enhance.net import Net, colour_change, hard_gate


def inputs(b=1, k=2, h=32, w=48, seed=0):
    g = torch.Generator().manual_seed(seed)
    rgb = torch.rand(b, 3, h, w, generator=g)
    return rgb, torch.randn(b, k, 16, h // 8, w // 8, generator=g), torch.ones(b, k, 1, h // 8, w // 8)


@pytest.mark.parametrize("k", [0, 1, 4])
def test_an_untrained_network_changes_nothing_with_any_history(k):
    rgb, latents, valid = inputs(k=k)
    with torch.inference_mode():
        out = Net(SMALL)(rgb, None, latents, valid)
    assert torch.equal(out.rgb, rgb) and out.latent.shape == (1, 16, 4, 6)


def test_history_outside_the_image_has_no_influence():
    rgb, latents, valid = inputs()
    net = stirred()
    with torch.inference_mode():
        alone = net(rgb, None, latents[:, :0], valid[:, :0]).rgb
        invalid = net(rgb, None, latents, torch.zeros_like(valid)).rgb
        used = net(rgb, None, latents, valid).rgb
    assert torch.allclose(alone, invalid, atol=1e-6) and not torch.allclose(alone, used, atol=1e-4)


def test_an_unknown_mask_equals_no_mask_and_differs_from_an_empty_one():
    rgb, latents, valid = inputs()
    net, shape = stirred(), (1, 1, 32, 48)
    with torch.inference_mode():
        none = net(rgb, None, latents, valid).rgb
        assert torch.equal(none, net(rgb, torch.full(shape, torch.nan), latents, valid).rgb)
        assert not torch.equal(none, net(rgb, torch.zeros(shape), latents, valid).rgb)


def test_samples_of_a_batch_do_not_mix():
    rgb, latents, valid = inputs(b=2)
    net = stirred()
    with torch.inference_mode():
        both = net(rgb, None, latents, valid).rgb
        second = net(rgb[1:], None, latents[1:], valid[1:]).rgb
    assert torch.allclose(both[1:], second, atol=1e-5)


def test_the_gate_closes_exactly():
    with torch.no_grad():
        gate = hard_gate(torch.tensor([-9.0, 0.0, 9.0]))
    assert gate[0] == 0 and gate[2] > 0.999 and 0 < gate[1] < 1


def test_a_closed_gate_still_has_a_gradient():
    logit = torch.tensor([-4.0], requires_grad=True)
    hard_gate(logit).backward()
    assert logit.grad is not None and logit.grad > 0


def test_colour_fields_scale_saturate_and_offset():
    rgb = torch.rand(1, 3, 16, 16)
    fields = torch.zeros(1, 12, 2, 2)
    fields[:, 3:6] = -0.25
    assert torch.allclose(colour_change(rgb, fields), -0.25 * rgb, atol=1e-6)
    fields = torch.zeros(1, 12, 2, 2)
    fields[:, 9:] = 1
    grey = rgb + colour_change(rgb, fields)
    assert torch.allclose(grey, grey[:, :1].expand_as(grey), atol=1e-6)


def test_the_frozen_encoder_gets_no_gradient():
    rgb, latents, valid = inputs()
    net = stirred().train()
    net(rgb, None, latents, valid).rgb.sum().backward()
    assert all(p.grad is None for p in net.encoder.parameters()) and net.stem.fine.weight.grad is not None


def test_the_autoencoder_keeps_the_size():
    image, latent = Autoencoder()(torch.rand(2, 3, 24, 40))
    assert image.shape == (2, 3, 24, 40) and latent.shape == (2, 16, 3, 5)
