"""The network by itself."""

import pytest
import torch
from small_net import SMALL, stirred

from enhance.network.autoencoder import Autoencoder
from enhance.network.net import Net, blend_of, photos_of
from enhance.network.past import Past


def inputs(b=1, k=2, h=32, w=48, seed=0, net=None):
    """A frame, and a past of `k` frames as `net`, stirred where None, saw them."""
    g = torch.Generator().manual_seed(seed)
    rgb = torch.rand(b, 3, h, w, generator=g)
    past = None
    with torch.inference_mode():
        for _ in range(k):
            past = (net or stirred())(torch.rand(b, 3, h, w, generator=g), None, past).past
    return rgb, past


def away(past: Past) -> Past:
    """A past that has left the image."""
    return past.moved(torch.full((*past.seen.shape[:1], 2, *past.seen.shape[-2:]), 1e4))


@pytest.mark.parametrize("k", [0, 1, 4])
def test_an_untrained_network_changes_nothing_with_any_past(k):
    net = Net(SMALL).eval()
    rgb, past = inputs(k=k, net=net)
    with torch.inference_mode():
        out = net(rgb, None, past)
    assert torch.equal(out.rgb, rgb) and out.latent.shape == (1, 16, 4, 6) and out.past.latents.shape[1] == min(k + 1, 4)


def test_a_past_outside_the_image_has_no_influence():
    rgb, past = inputs()
    net = stirred()
    with torch.inference_mode():
        alone, gone, used = (net(rgb, None, p).rgb for p in (None, away(past), past))
    assert torch.allclose(alone, gone, atol=1e-6) and not torch.allclose(alone, used, atol=1e-4)


def test_an_unknown_mask_equals_no_mask_and_differs_from_an_empty_one():
    rgb, past = inputs()
    net, shape = stirred(), (1, 1, 32, 48)
    with torch.inference_mode():
        none = net(rgb, None, past).rgb
        assert torch.equal(none, net(rgb, torch.full(shape, torch.nan), past).rgb)
        assert not torch.equal(none, net(rgb, torch.zeros(shape), past).rgb)


def test_samples_of_a_batch_do_not_mix():
    rgb, past = inputs(b=2)
    net = stirred()
    second = Past(**{name: value[1:] for name, value in vars(past).items()})
    with torch.inference_mode():
        both, one = net(rgb, None, past).rgb, net(rgb[1:], None, second).rgb
    assert torch.allclose(both[1:], one, atol=1e-5)


def test_photos_are_seen_where_they_are_trusted():
    rgb, _ = inputs(k=0)
    net, seen, trust = stirred(), torch.rand(1, 3, 32, 48), torch.zeros(1, 1, 32, 48)
    with torch.inference_mode():
        none = net(rgb).rgb
        assert torch.equal(none, net(rgb, photos=photos_of(seen, trust)).rgb)
        assert not torch.equal(none, net(rgb, photos=photos_of(seen, trust + 0.5)).rgb)


def test_the_last_picture_is_left_out_exactly():
    with torch.no_grad():
        share = blend_of(torch.tensor([-9.0, 0.0, 1.0, 9.0]))
    assert share[0] == 0 == share[1] and share[3] > 0.999 and 0 < share[2] < 1


def test_what_is_left_out_still_has_a_gradient():
    logit = torch.tensor([-4.0], requires_grad=True)
    blend_of(logit).backward()
    assert logit.grad is not None and logit.grad > 0


def test_the_frozen_parts_get_no_gradient():
    net = stirred().train()
    net(torch.rand(1, 3, 32, 48)).rgb.sum().backward()
    assert all(p.grad is None for p in net.encoder.parameters()) and net.stem.fine.weight.grad is not None


def test_the_autoencoder_keeps_the_size():
    image, latent = Autoencoder()(torch.rand(2, 3, 24, 40))
    assert image.shape == (2, 3, 24, 40) and latent.shape == (2, 16, 3, 5)
