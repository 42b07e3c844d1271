"""What the network knows of the frames before: their enhanced latents, and the last picture."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from enhance.alike import alike
from enhance.flow import shrink_flow
from enhance.network.autoencoder import LATENT, STRIDE
from enhance.tiles import Window, coarser
from render.warp import warp


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
