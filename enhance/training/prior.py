"""The prior: before it sees any damage, the transformer learns what latents of right pictures look like.

Flow matching (Lipman et al. 2023): a latent x0 and noise e give x_t = (1 - t) x0 + t e, and the network is to tell the velocity e - x0
from x_t and t. As in DiffusionHarmonizer it is then run once, on a latent without noise and at the time FIXED. The time comes in as what
its embedding differs by from that of FIXED, and the head is scaled so that x0 = x - head(x) there: turning many steps into one is leaving
the time out, and nothing of it is left in the enhancer.
"""

from __future__ import annotations

import math

import torch
from torch import nn
from torch.nn import functional as F

from enhance.network.net import PATCH, Net

FIXED = 0.2
"""Time of the one step, as NVIDIA's release has it."""
WAVES = 16


class Time(nn.Module):
    """Times `[B]` in 0..1 to what they add to every token, `[B, 1, 1, width]`: 0 at FIXED."""

    def __init__(self, width: int):
        super().__init__()
        self.embed = nn.Sequential(nn.Linear(2 * WAVES, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, t: torch.Tensor) -> torch.Tensor:
        both = torch.cat([t, t.new_full((1,), FIXED)])
        angles = both[:, None] * math.pi * 2 ** (torch.arange(WAVES, device=t.device) / 2)
        found = self.embed(torch.cat([angles.sin(), angles.cos()], 1))
        return (found[:-1] - found[-1:])[:, None, None]


def velocity(net: Net, time: Time, x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    """Of latents `x` `[B, 16, h, w]` at times `t` `[B]`, by the network's transformer alone: no frame, no past."""
    tokens = net.embed(x).permute(0, 2, 3, 1) + time(t)
    history = tokens[:, None, :, :, :][:, :0]
    for block in net.blocks:
        tokens = block(tokens, history, torch.zeros_like(history[..., 0], dtype=torch.bool))
    return F.pixel_shuffle(net.denoise(net.norm(tokens).permute(0, 3, 1, 2)), PATCH) / FIXED


def flow_matching_loss(net: Net, time: Time, x0: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Mean squared error of the velocity of clean latents `x0` `[B, 16, h, w]`, at times drawn around the middle (logit-normal)
    by a generator of their device."""
    t = torch.sigmoid(torch.randn(len(x0), generator=generator, device=x0.device)).to(x0)
    noise = torch.randn(x0.shape, generator=generator, device=x0.device).to(x0)
    x = torch.lerp(x0, noise, t[:, None, None, None])
    return (velocity(net, time, x, t) - (noise - x0)).square().mean()
