"""A sensor's noise: its variance in parts of a picture, and the picture without it.

Photons' noise grows with the root of light, in each channel by itself, so that the variance-stabilising transform 2 sqrt(light + FLOOR)
(Anscombe 1948, without its constants) has the same of it anywhere. Finest detail of surfaces is nearly grey: what two opponent colours have
in the highest frequencies of small blocks' DCT is noise, and its median over blocks is robust (0.99 to 1.23 of the variance for eight of
ten parts of photos made noisy; of right ones it stays below what is seen). It is removed by sliding-window DCT denoising, in grey and
opponent colours (Yu and Sapiro 2011), blocks weighted by how few coefficients they keep (Guleryuz 2007).
"""

from __future__ import annotations

import math

import torch
from kornia.color import rgb_to_linear_rgb
from torch.nn import functional as F

from enhance.correcting.grain import NORMAL
from enhance.correcting.shade import at_most
from enhance.pairs.isp import FLOOR

SIDE, STEP, FINEST = 8, 4, 6.5
"""Pixels of the blocks that are measured, and from one to the next; and the frequency in half waves from which on all is noise."""

FEWEST, MOST = 12, 256
"""Blocks that tell a part's noise, and how many are looked at, at most: more say nothing else."""

WITHIN = 0.95
"""Share of a block's pixels that must be the part's."""

BLACK, WHITE = 0.5 / 255, 253.5 / 255
"""Nearer to black and to white than these a sensor's noise is cut off."""

WINDOW, SLIDE, THRESHOLD = 4, 2, 2.7
"""Pixels of the blocks that are denoised, and from one to the next; and below how many of the noise's deviations a coefficient goes."""


def _opponents() -> torch.Tensor:
    """Grey and two opponent colours, orthonormal `[3, 3]`."""
    rows = torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.0, -1.0], [1.0, -2.0, 1.0]])
    return rows / rows.norm(dim=1, keepdim=True)


def _dct(side: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The DCT-II of a block, orthonormal `[side^2, side^2]`, and its frequencies `[side^2]` in half waves."""
    k = torch.arange(side, dtype=torch.float32)
    line = torch.cos(math.pi * (2 * k + 1) * k[:, None] / (2 * side)) * math.sqrt(2 / side)
    line[0] /= math.sqrt(2)
    return torch.kron(line, line), torch.hypot(k[:, None], k).flatten()


OPPONENTS = _opponents()
_WAVES, _FREQUENCIES = _dct(SIDE)
MEASURED = _WAVES[_FREQUENCIES > FINEST]
SLIDING = _dct(WINDOW)[0].view(WINDOW**2, 1, WINDOW, WINDOW)


def variances(rgb: torch.Tensor, parts: tuple[torch.Tensor, ...]) -> tuple[float, ...] | None:
    """The noise variance, after the variance-stabilising transform, of a picture `[3, h, w]` in each of the parts, bool `[h, w]`; None
    where too little of one tells."""
    if min(rgb.shape[1:]) < SIDE:
        return None
    clear = ((rgb > BLACK) & (rgb < WHITE)).all(0)
    blocks = rgb.unfold(1, SIDE, STEP).unfold(2, SIDE, STEP)
    found = []
    for part in parts:
        at = (F.avg_pool2d((part & clear)[None].to(rgb), SIDE, STEP)[0] > WITHIN).nonzero()
        if len(at) < FEWEST:
            return None
        y, x = at[at_most(MOST, len(at), at.device)].unbind(1)
        stable = stabilized(rgb_to_linear_rgb(blocks[:, y, x].flatten(2)))
        colours = torch.einsum("ij,jnp->inp", OPPONENTS[1:].to(rgb), stable)
        found.append(float((colours @ MEASURED.to(rgb).T).square().median() / NORMAL))
    return tuple(found)


def denoised(light: torch.Tensor, variance: float) -> torch.Tensor:
    """Linear `light` `[3, h, w]` without noise of such a variance after the variance-stabilising transform."""
    waves, opponents = SLIDING.to(light), OPPONENTS.to(light)
    planes = torch.einsum("ij,jhw->ihw", opponents, stabilized(light))[:, None]
    found = F.conv2d(F.pad(planes, (WINDOW - 1,) * 4, mode="replicate"), waves, stride=SLIDE)
    kept = found.square() > THRESHOLD**2 * variance
    kept[:, 0] = True
    weight = 1 / kept.sum(1, keepdim=True)  # blocks that keep little keep little noise
    total = F.conv_transpose2d(found * kept * weight, waves, stride=SLIDE)
    weights = F.conv_transpose2d(weight.to(light), torch.ones_like(waves[:1]), stride=SLIDE)
    rows, columns = (slice(WINDOW - 1, WINDOW - 1 + n) for n in light.shape[1:])
    stable = torch.einsum("ji,jhw->ihw", opponents, (total / weights)[:, 0, rows, columns])
    return (stable.clamp_min(2 * math.sqrt(FLOOR)) / 2).square() - FLOOR


def stabilized(light: torch.Tensor) -> torch.Tensor:
    """2 sqrt(light + FLOOR): noise has the same variance anywhere."""
    return 2 * (light.clamp_min(0) + FLOOR).sqrt()
