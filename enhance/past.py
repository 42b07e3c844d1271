"""What the network knows of the frames before: their enhanced latents, the last picture, and the colour fields so far."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from enhance.autoencoder import LATENT, STRIDE
from enhance.colour import FIELDS
from enhance.flow import shrink_flow
from render.warp import warp

STEADY = 3
"""Frames whose colour fields are averaged with a new one's, at most."""


@dataclass(frozen=True)
class Past:
    """The past of a batch of clips, as it would look in the coming frame.

    latents  `[B, K, 16, H/8, W/8]`: enhanced latents, newest first, K from 0
    valid    `[B, K, 1, H/8, W/8]`: 1 where those were inside the image
    rgb      `[B, 3, H, W]`: the last enhanced picture
    seen     `[B, 1, H, W]`: 1 where that was inside the image; 0 throughout at the start
    fields   `[B, 13, h, w]`: the mean of the colour fields so far
    count    `[B, 1, h, w]`: how many frames are in that mean, 0 to STEADY
    """

    latents: torch.Tensor
    valid: torch.Tensor
    rgb: torch.Tensor
    seen: torch.Tensor
    fields: torch.Tensor
    count: torch.Tensor

    @classmethod
    def none(cls, rgb: torch.Tensor) -> Past:
        """The past of a first frame `[B, 3, H, W]`."""
        b, _, h, w = rgb.shape
        latents = rgb.new_zeros(b, 0, LATENT, h // STRIDE, w // STRIDE)
        return cls(
            latents,
            latents[:, :, :1],
            torch.zeros_like(rgb),
            torch.zeros_like(rgb[:, :1]),
            rgb.new_zeros(b, FIELDS, 1, 1),
            rgb.new_zeros(b, 1, 1, 1),
        )

    def moved(self, flow_prev: torch.Tensor) -> Past:
        """Brought to the next frame by its flow `[B, 2, H, W]` to the frame before; where that is unknown nothing is known."""
        rgb, inside = warp(torch.cat([self.rgb, self.seen], 1), flow_prev)
        grid = shrink_flow(flow_prev, self.fields.shape[-2:])
        mean, inside_grid = warp(torch.cat([self.fields, self.count], 1), grid)
        latents, valid = self.latents, self.valid
        if latents.shape[1]:
            b, k = latents.shape[:2]
            coarse = shrink_flow(flow_prev, latents.shape[-2:]).repeat_interleave(k, 0)
            both, inside_coarse = warp(torch.cat([latents.flatten(0, 1), valid.flatten(0, 1)], 1), coarse)
            latents = both[:, :-1].unflatten(0, (b, k))
            valid = ((both[:, -1:] > 0.5) * inside_coarse).unflatten(0, (b, k))
        return Past(latents, valid, rgb[:, :3], (rgb[:, 3:] > 0.99) * inside, mean[:, :-1], mean[:, -1:].round() * inside_grid)

    def averaged(self, fields: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """A new frame's `fields` averaged with those so far, and the count after it."""
        if self.fields.shape[-2:] != fields.shape[-2:]:
            return fields, torch.ones_like(fields[:, :1])
        return (fields + self.count * self.fields) / (1 + self.count), (self.count + 1).clamp_max(STEADY)

    def followed(self, rgb: torch.Tensor, latent: torch.Tensor, fields: torch.Tensor, count: torch.Tensor, longest: int) -> Past:
        """The past after one more frame, at most `longest` latents long; holds no graph."""
        rgb, latent = rgb.detach(), latent.detach()
        latents = torch.cat([latent[:, None], self.latents], 1)[:, :longest]
        valid = torch.cat([torch.ones_like(latent[:, None, :1]), self.valid], 1)[:, :longest]
        return Past(latents, valid, rgb, torch.ones_like(rgb[:, :1]), fields.detach(), count.detach())
