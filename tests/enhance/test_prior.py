"""The prior of clean latents."""

import torch
from small_net import SMALL

from enhance.network.net import Net
from enhance.training.prior import FIXED, Time, flow_matching_loss, velocity


def test_at_the_fixed_time_nothing_is_left_of_time():
    time = Time(24)
    added = time(torch.tensor([FIXED, 0.7]))
    assert added[0].abs().max() < 1e-6 and added[1].abs().max() > 1e-3


def test_one_step_of_the_prior_is_the_enhancers():
    torch.manual_seed(0)
    net, rgb = Net(SMALL).eval(), torch.rand(1, 3, 48, 64)
    torch.nn.init.normal_(net.denoise.weight, std=0.05)
    for parameter in net.stem.parameters():
        torch.nn.init.zeros_(parameter)
    with torch.no_grad():
        latent = net.encoder(rgb)
        step = latent - FIXED * velocity(net, Time(24), latent, torch.tensor([FIXED]))
        assert torch.allclose(net(rgb).latent, step, atol=1e-5)


def test_it_learns_what_right_latents_look_like():
    torch.manual_seed(0)
    net, time = Net(SMALL), Time(24)
    right = torch.randn(1, 16, 4, 4).expand(16, -1, -1, -1)
    parameters = [p for part in (time, net.embed, net.blocks, net.norm, net.denoise) for p in part.parameters()]
    optimiser = torch.optim.Adam(parameters, 1e-2)
    losses = []
    for step in range(60):
        loss = flow_matching_loss(net, time, right, torch.Generator().manual_seed(step))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert sum(losses[-5:]) < 0.6 * sum(losses[:5])
