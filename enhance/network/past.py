"""What the network knows of the frames before: their enhanced latents, and the last picture."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch.nn import functional as F

from enhance.flow import shrink_flow
from enhance.network.autoencoder import LATENT, STRIDE
from enhance.tiles import Window, coarser
from render.warp import warp

BLOCKS = (18, 32)
CUT = 0.5
"""Mean difference of pictures shrunk to BLOCKS, against how much those vary within themselves, from which they do not show the same place.
Measured on 480 frames of drives: up to 0.29 from a frame to the next, 0.75 and more between places."""

LONG = 160
"""Pixels of a thinned picture's longer side."""


@dataclass(frozen=True)
class Past:
    """The past of a batch of clips, as it would look in the coming frame.

    latents  `[B, K, 16, H/8, W/8]`: enhanced latents, newest first, K from 0
    valid    `[B, K, 1, H/8, W/8]`: 1 where those were inside the image
    rgb      `[B, 3, H, W]`: the last enhanced picture
    seen     `[B, 1, H, W]`: 1 where that was inside the image; 0 throughout at the start
    """

    latents: torch.Tensor
    valid: torch.Tensor
    rgb: torch.Tensor
    seen: torch.Tensor

    @classmethod
    def none(cls, rgb: torch.Tensor) -> Past:
        """The past of a first frame `[B, 3, H, W]`."""
        b, _, h, w = rgb.shape
        latents = rgb.new_zeros(b, 0, LATENT, h // STRIDE, w // STRIDE)
        return cls(latents, latents[:, :, :1], torch.zeros_like(rgb), torch.zeros_like(rgb[:, :1]))

    def moved(self, flow_prev: torch.Tensor) -> Past:
        """Brought to the next frame by its flow `[B, 2, H, W]` to the frame before; where that is unknown nothing is known."""
        rgb, inside = warp(torch.cat([self.rgb, self.seen], 1), flow_prev)
        latents, valid = self.latents, self.valid
        if latents.shape[1]:
            b, k = latents.shape[:2]
            coarse = shrink_flow(flow_prev, latents.shape[-2:]).repeat_interleave(k, 0)
            both, inside_coarse = warp(torch.cat([latents.flatten(0, 1), valid.flatten(0, 1)], 1), coarse)
            latents = both[:, :-1].unflatten(0, (b, k))
            valid = ((both[:, -1:] > 0.5) * inside_coarse).unflatten(0, (b, k))
        return Past(latents, valid, rgb[:, :3], (rgb[:, 3:] > 0.99) * inside)

    def fitting(self, rgb: torch.Tensor) -> Past:
        """What of it belongs to the coming frame `[B, 3, H, W]`: nothing after a cut or a jump, where the two do not look alike."""
        fits = alike(rgb, self.rgb, self.seen).to(rgb.dtype)[:, None, None, None]
        return replace(self, valid=self.valid * fits[:, None], seen=self.seen * fits)

    def cropped(self, window: Window) -> Past:
        """In a window of the frame; its sides are multiples of STRIDE."""
        rows, columns = coarser(window, STRIDE)
        y, x = window
        latents, valid = self.latents[..., rows, columns], self.valid[..., rows, columns]
        return replace(self, latents=latents, valid=valid, rgb=self.rgb[..., y, x], seen=self.seen[..., y, x])

    def followed(
        self,
        rgb: torch.Tensor,
        latent: torch.Tensor,
        longest: int,
        known: torch.Tensor | None = None,
    ) -> Past:
        """The past after one more frame, at most `longest` latents long; holds no graph. `known` `[B, 1, H/8, W/8]`: 1 where `latent` is
        known; everywhere where None."""
        rgb, latent = rgb.detach(), latent.detach()
        known = torch.ones_like(latent[:, :1]) if known is None else known
        latents = torch.cat([latent[:, None], self.latents], 1)[:, :longest]
        valid = torch.cat([known[:, None], self.valid], 1)[:, :longest]
        return Past(latents, valid, rgb, torch.ones_like(rgb[:, :1]))


def thin(image: torch.Tensor) -> torch.Tensor:
    """Evenly spaced pixels of `[B, C, H, W]`: the longer side LONG, both even; a small picture keeps all its pixels but an odd row's."""
    sides = image.shape[-2:]
    share = min(1.0, LONG / max(sides))
    small = [max(2, 2 * round(side * share / 2 - 0.25)) for side in sides]
    y, x = (torch.linspace(0, side - 1, n, device=image.device).round().long() for side, n in zip(sides, small, strict=True))
    return image[..., y[:, None], x]


def alike(rgb: torch.Tensor, last: torch.Tensor, seen: torch.Tensor | None = None) -> torch.Tensor:
    """Whether pictures `[B, 3, H, W]` show one place, bool `[B]`. `seen` `[B, 1, H, W]`: 1 where `last` is known, everywhere if None."""
    now, then = thin(rgb), thin(last)
    known = torch.ones_like(now[:, :1]) if seen is None else thin(seen)
    then = torch.lerp(now, then, known)
    now, then = F.adaptive_avg_pool2d(now, BLOCKS), F.adaptive_avg_pool2d(then, BLOCKS)
    apart = (now - then).abs().mean((1, 2, 3)) / known.mean((1, 2, 3)).clamp_min(1e-3)
    varies = torch.stack([(x - x.mean((2, 3), keepdim=True)).abs().mean((1, 2, 3)) for x in (now, then)]).mean(0)
    return apart < CUT * (varies + 0.02)
