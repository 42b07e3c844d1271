"""The convolutional autoencoder: 8 x 8 pixels become one latent of 16 numbers. Trained first, frozen afterwards.

It starts from 4 x 4 pixel blocks, so no convolution runs on full-size images: on a CPU that is where an ordinary
variational autoencoder spends nearly all its time.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

from enhance.network.precision import lower

LATENT = 16
STRIDE = 8


def zero(layer: nn.Conv2d) -> None:
    """Weights and bias 0: the layer starts without effect."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)


def on_blocks(layer: nn.Conv2d, image: torch.Tensor, side: int) -> torch.Tensor:
    """The 3 x 3 convolution `layer` of an image's blocks of `side` x `side` pixels (`F.pixel_unshuffle`), as one of the image itself with a
    stride: laying out the blocks would take longer than convolving them."""
    channels = image.shape[1]
    weight = layer.weight.unflatten(1, (channels, side, side)).permute(0, 1, 4, 2, 5, 3).reshape(-1, channels, 3 * side, 3 * side)
    return F.conv2d(image.contiguous(memory_format=torch.channels_last), weight, layer.bias, stride=side, padding=side)


class Residual(nn.Module):
    """x + conv(silu(conv(silu(x)))): two 3 x 3 convolutions, the second zero at first, so a new block is the identity."""

    def __init__(self, width: int):
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        zero(self.second)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + self.second(F.silu(self.first(F.silu(x))))


QUARTER, EIGHTH = 48, 96
"""Channels at a quarter and at an eighth of the picture's size."""


class Encoder(nn.Module):
    """sRGB `[B, 3, H, W]` in 0..1, sides multiples of 8, to latents `[B, 16, H/8, W/8]` of about unit variance."""

    def __init__(self):
        super().__init__()
        self.stem = nn.Conv2d(48, QUARTER, 3, padding=1)
        self.quarter = Residual(QUARTER)
        self.down = nn.Conv2d(QUARTER, EIGHTH, 3, stride=2, padding=1)
        self.eighth = nn.Sequential(Residual(EIGHTH), Residual(EIGHTH))
        self.head = nn.Conv2d(EIGHTH, LATENT, 1)

    def features(self, rgb: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Features at a quarter `[B, 48, H/4, W/4]` and an eighth `[B, 96, H/8, W/8]` of the size, and the latents."""
        quarter = self.quarter(on_blocks(self.stem, lower(rgb * 2 - 1), 4))
        eighth = self.eighth(self.down(F.silu(quarter)))
        return quarter, eighth, self.head(eighth)

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        return self.features(rgb)[2]


class Decoder(nn.Module):
    """Latents `[B, 16, H/8, W/8]` back to sRGB `[B, 3, H, W]`."""

    def __init__(self):
        super().__init__()
        self.stem = nn.Conv2d(LATENT, EIGHTH, 3, padding=1)
        self.eighth = nn.Sequential(Residual(EIGHTH), Residual(EIGHTH))
        self.up = nn.Conv2d(EIGHTH, QUARTER * 4, 1)
        self.quarter = Residual(QUARTER)
        self.head = nn.Conv2d(QUARTER, 48, 3, padding=1)

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        x = F.pixel_shuffle(self.up(self.eighth(self.stem(latent))), 2)
        return F.pixel_shuffle(self.head(F.silu(self.quarter(x))), 4) * 0.5 + 0.5


class Autoencoder(nn.Module):
    """Encoder and decoder together; `forward` returns the reconstruction and the latents."""

    def __init__(self):
        super().__init__()
        self.encoder = Encoder()
        self.decoder = Decoder()

    def forward(self, rgb: torch.Tensor, noise: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
        """Noise on the latents in training keeps them smooth: neighbours in latent space decode to like images."""
        latent = self.encoder(rgb)
        return self.decoder(latent + noise * torch.randn_like(latent) if noise else latent), latent
