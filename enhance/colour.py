"""Colours that do not belong, found and undone: a small U-Net looks at the whole picture at once, thinned to some thousand pixels.

Harmonization is comparing an object's colours with the rest of the picture. That takes the whole picture but no detail: evenly
spaced pixels keep the palette exactly, and the network sees a thousand pictures in the time that full frames would take for ten.
It gives fields: where colours are altered, and a smooth field of quadratic tone curves and saturation that undoes it.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

from enhance.attention import SpatialBlock
from enhance.autoencoder import Residual, on_blocks, zero

LONG = 160
"""Pixels of the thinned picture's longer side."""
COEFFICIENTS = 12
FIELDS = COEFFICIENTS + 1
"""Channels of the fields: the colour change's coefficients, and the logit of where colours are altered."""
LUMA = (0.299, 0.587, 0.114)


def thin(image: torch.Tensor) -> torch.Tensor:
    """Evenly spaced pixels of `[B, C, H, W]`: the longer side LONG, both even; a small picture keeps all its pixels but an odd row's."""
    sides = image.shape[-2:]
    share = min(1.0, LONG / max(sides))
    small = [max(2, 2 * round(side * share / 2 - 0.25)) for side in sides]
    y, x = (torch.linspace(0, side - 1, n, device=image.device).round().long() for side, n in zip(sides, small, strict=True))
    return image[..., y[:, None], x]


class ColourNet(nn.Module):
    """Thinned frame `[B, 3, h, w]` and mask `[B, 2, h, w]` (with whether it is known) to fields `[B, 13, h/2, w/2]`; zero at first."""

    def __init__(self, fine: int = 32, middle: int = 64, coarse: int = 128):
        super().__init__()
        self.stem = nn.Conv2d(4 * 5, fine, 3, padding=1)
        self.fine = Residual(fine)
        self.down = nn.Conv2d(fine, middle, 3, stride=2, padding=1)
        self.middle = Residual(middle)
        self.further = nn.Conv2d(middle, coarse, 3, stride=2, padding=1)
        self.coarse = Residual(coarse)
        self.blocks = nn.ModuleList(SpatialBlock(coarse, 4) for _ in range(2))
        self.up = nn.Conv2d(coarse, middle, 1)
        self.middle_up = Residual(middle)
        self.up_further = nn.Conv2d(middle, fine, 1)
        self.fine_up = Residual(fine)
        self.head = nn.Conv2d(fine, FIELDS, 3, padding=1)
        zero(self.head)

    def forward(self, rgb: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        fine = self.fine(on_blocks(self.stem, torch.cat([rgb * 2 - 1, mask], 1), 2))
        middle = self.middle(self.down(F.silu(fine)))
        x = self.coarse(self.further(F.silu(middle))).permute(0, 2, 3, 1)
        for block in self.blocks:
            x = block(x)
        x = self.middle_up(middle + F.interpolate(self.up(x.permute(0, 3, 1, 2)), middle.shape[-2:]))
        x = self.fine_up(fine + F.interpolate(self.up_further(F.silu(x)), fine.shape[-2:]))
        return self.head(F.silu(x)).float()


def colour_change(rgb: torch.Tensor, fields: torch.Tensor) -> torch.Tensor:
    """What the first 12 of `fields` `[B, 13, h, w]` add to `rgb` `[B, 3, H, W]`: per channel a + b x + c x^2 + d (luma - x)."""
    coefficients = enlarged(fields[:, :COEFFICIENTS], rgb.shape[-2:])
    a, b, c, d = coefficients.chunk(4, 1)
    luma = LUMA[0] * rgb[:, :1] + LUMA[1] * rgb[:, 1:2] + LUMA[2] * rgb[:, 2:]
    return torch.addcmul(a, rgb, b + c * rgb) + d * (luma - rgb)


def altered_logits(fields: torch.Tensor, size: torch.Size | tuple[int, int]) -> torch.Tensor:
    """The last of `fields` `[B, 13, h, w]` at a picture's size: logits `[B, 1, H, W]` of where colours are altered."""
    return enlarged(fields[:, COEFFICIENTS:], size)


def enlarged(fields: torch.Tensor, size: torch.Size | tuple[int, int]) -> torch.Tensor:
    """Fields `[B, C, h, w]` at a picture's `size`; as they are where they have it."""
    if tuple(fields.shape[-2:]) == tuple(size):
        return fields
    return F.interpolate(fields, size, mode="bilinear", align_corners=False)
