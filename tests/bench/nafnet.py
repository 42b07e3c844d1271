"""NAFNet (Chen et al., Simple Baselines for Image Restoration, ECCV 2022), as a baseline: no activations but products of halves."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

from enhance.network.autoencoder import zero


class ChannelNorm(nn.LayerNorm):
    """Layer norm over the channels of `[B, C, H, W]`, pixel by pixel."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


def halves_multiplied(x: torch.Tensor) -> torch.Tensor:
    """SimpleGate: the first half of the channels times the second."""
    a, b = x.chunk(2, 1)
    return a * b


class Block(nn.Module):
    """Depthwise convolution and channel attention, then a perceptron; each branch scaled by a parameter that starts at 0."""

    def __init__(self, width: int):
        super().__init__()
        self.before, self.then = ChannelNorm(width, eps=1e-6), ChannelNorm(width, eps=1e-6)
        self.widen = nn.Conv2d(width, 2 * width, 1)
        self.mix = nn.Conv2d(2 * width, 2 * width, 3, padding=1, groups=2 * width)
        self.attend = nn.Conv2d(width, width, 1)
        self.narrow = nn.Conv2d(width, width, 1)
        self.perceive = nn.Conv2d(width, 2 * width, 1)
        self.out = nn.Conv2d(width, width, 1)
        self.beta, self.gamma = (nn.Parameter(torch.zeros(1, width, 1, 1)) for _ in range(2))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = halves_multiplied(self.mix(self.widen(self.before(x))))
        y = self.narrow(y * self.attend(F.adaptive_avg_pool2d(y, 1)))
        x = x + self.beta * y
        return x + self.gamma * self.out(halves_multiplied(self.perceive(self.then(x))))


class NafNet(nn.Module):
    """The paper's layout for denoising; 12 channels wide instead of 32 it has 4.1 million weights, as our network has 4.3.

    It is given what ours is given of a single frame: the picture, the told mask and whether there is one.
    """

    def __init__(self, width: int = 12, down: tuple[int, ...] = (2, 2, 4, 8), middle: int = 12, up: tuple[int, ...] = (2, 2, 2, 2)):
        super().__init__()
        self.first = nn.Conv2d(5, width, 3, padding=1)
        widths = [width * 2**i for i in range(len(down) + 1)]
        self.down = nn.ModuleList(nn.Sequential(*(Block(w) for _ in range(n))) for w, n in zip(widths, down, strict=False))
        self.shrink = nn.ModuleList(nn.Conv2d(w, 2 * w, 2, stride=2) for w in widths[:-1])
        self.middle = nn.Sequential(*(Block(widths[-1]) for _ in range(middle)))
        self.grow = nn.ModuleList(nn.Sequential(nn.Conv2d(w, 2 * w, 1, bias=False), nn.PixelShuffle(2)) for w in widths[:0:-1])
        self.up = nn.ModuleList(nn.Sequential(*(Block(w) for _ in range(n))) for w, n in zip(widths[-2::-1], up, strict=True))
        self.last = nn.Conv2d(width, 3, 3, padding=1)
        zero(self.last)

    def forward(self, rgb: torch.Tensor, told: torch.Tensor) -> torch.Tensor:
        """Picture `[B, 3, H, W]` and mask with whether it is known `[B, 2, H, W]`, sides multiples of 16, to the better picture."""
        x, skips = self.first(torch.cat([rgb, told], 1)), []
        for blocks, shrink in zip(self.down, self.shrink, strict=True):
            skips.append(blocks(x))
            x = shrink(skips[-1])
        x = self.middle(x)
        for grow, blocks in zip(self.grow, self.up, strict=True):
            x = blocks(grow(x) + skips.pop())
        return rgb + self.last(x).float()
