"""The enhancer's network: a single-step latent transformer between a frozen encoder and a decoder that sees the frame.

After DiffusionHarmonizer, small. The clean latent goes through the transformer once, at a fixed timestep and without text;
because both never change, what their embeddings would add to every layer is stored as constants (`Modulation`). Spatial
attention alternates with temporal attention over the latents of up to `history` frames enhanced before. The decoder gets
features of the input frame at every scale, and the output is

    output = input + gate * (colour + residual)

where colour is a smooth field of quadratic tone curves and saturation (plus one such change for the gate's region as a whole,
from comparing its palette with the rest), the residual is free, and the gate is exactly 0 where the
frame is to be left alone. Colour and residual are zero in an untrained network, which therefore changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from enhance.autoencoder import LATENT, STRIDE, Encoder, Residual, zero
from enhance.palette import LUMA, RegionColour

PATCH = 2  # latents per token side
MULTIPLE = STRIDE * PATCH  # a frame's sides are padded to multiples of this
SHUT_TRAINING, SHUT_TOLD, SHUT_ALONE = 0.1, 0.5, 1.0  # see hard_gate; the latter two keep clean frames above 42 dB
MASK_CHANNELS = 2  # the mask, and whether there is one


@dataclass(frozen=True)
class NetConfig:
    """Sizes of the network; stored with its weights."""

    width: int = 192
    """Channels of a token."""
    blocks: int = 4
    """Transformer blocks: spatial attention, temporal attention, perceptron."""
    heads: int = 3
    """Attention heads."""
    history: int = 4
    """Most previous latents attended to."""
    half: int = 24
    """Channels of the decoder at half size."""
    quarter: int = 48
    """Channels at quarter size."""
    eighth: int = 96
    """Channels at an eighth."""


class Modulation(nn.Module):
    """Normalise, scale and shift tokens `[..., C]`, and gate a branch: adaptive layer norm at one fixed condition.

    With the timestep fixed (a clean latent) and the text empty, the conditioning network's outputs are constants, so the
    constants are the parameters.
    """

    def __init__(self, width: int):
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.gate = nn.Parameter(torch.full((width,), 0.2))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.norm(x)


class SpatialAttention(nn.Module):
    """Every token of a frame attends to every other: tokens `[B, h, w, C]`."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        b, h, w, c = x.shape
        q, k, v = self.qkv(x).reshape(b, h * w, 3, self.heads, c // self.heads).permute(2, 0, 3, 1, 4)
        return self.out(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(b, h, w, c))


class TemporalAttention(nn.Module):
    """Every token attends to itself and to the history at its own place: tokens `[B, h, w, C]`, history `[B, K, h, w, C]`.

    `valid` bool `[B, K, h, w]` says where the history was inside the image. Without history a token sees itself alone, so
    the layer works for any length from 0.
    """

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)

    def forward(self, x: torch.Tensor, history: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
        b, h, w, c = x.shape
        seen = torch.cat([x[:, None], history], 1)
        m, d = seen.shape[1], c // self.heads
        k, v = self.key_value(seen).reshape(b, m, h, w, 2, self.heads, d).unbind(4)
        q = self.query(x).reshape(b, 1, h, w, self.heads, d)
        score = (q * k).sum(-1) * d**-0.5
        allowed = torch.cat([torch.ones_like(valid[:, :1]) if valid.shape[1] else valid.new_ones(b, 1, h, w), valid], 1)
        weight = score.float().masked_fill(~allowed[..., None], -torch.inf).softmax(1).to(v.dtype)
        return self.out((weight[..., None] * v).sum(1).reshape(b, h, w, c))


class Perceptron(nn.Module):
    """Widen, mix each token with its 8 neighbours (which also tells position), narrow: tokens `[B, h, w, C]`."""

    def __init__(self, width: int):
        super().__init__()
        self.widen = nn.Linear(width, 2 * width)
        self.mix = nn.Conv2d(2 * width, 2 * width, 3, padding=1, groups=2 * width)
        self.narrow = nn.Linear(2 * width, width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        wide = self.widen(x)
        mixed = self.mix(wide.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
        return self.narrow(F.silu(wide + mixed))


class Block(nn.Module):
    """Spatial attention, temporal attention, perceptron, each behind its modulation."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.spatial, self.temporal, self.perceptron = SpatialAttention(width, heads), TemporalAttention(width, heads), Perceptron(width)
        self.modulation = nn.ModuleList(Modulation(width) for _ in range(3))

    def forward(self, x: torch.Tensor, history: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
        first, second, third = self.modulation
        x = x + first.gate * self.spatial(first(x))
        x = x + second.gate * self.temporal(second(x), history, valid)
        return x + third.gate * self.perceptron(third(x))


class Stem(nn.Module):
    """Trainable features of the input frame and mask at 1/2, 1/4, 1/8 of the size and as tokens at 1/16."""

    def __init__(self, c: NetConfig):
        super().__init__()
        self.fine = nn.Conv2d(4 * (3 + MASK_CHANNELS), c.half, 3, padding=1)
        self.quarter = nn.Conv2d(c.half, c.quarter, 3, stride=2, padding=1)
        self.quarter_block = Residual(c.quarter)
        self.eighth = nn.Conv2d(c.quarter, c.eighth, 3, stride=2, padding=1)
        self.eighth_block = Residual(c.eighth)
        self.token = nn.Conv2d(c.eighth, c.width, 2, stride=2)

    def forward(self, frame: torch.Tensor) -> tuple[torch.Tensor, ...]:
        half = F.silu(self.fine(F.pixel_unshuffle(frame, 2)))
        quarter = self.quarter_block(self.quarter(half))
        eighth = self.eighth_block(self.eighth(F.silu(quarter)))
        return half, quarter, eighth, self.token(F.silu(eighth))


class FrameDecoder(nn.Module):
    """Tokens and the input frame's features to the gate, the colour field and the residual."""

    def __init__(self, c: NetConfig):
        super().__init__()
        self.up_eighth = nn.Conv2d(c.width, 4 * c.eighth, 1)
        self.latent = nn.Conv2d(LATENT, c.eighth, 3, padding=1)
        self.norm = nn.GroupNorm(1, c.eighth)
        self.eighth = Residual(c.eighth)
        self.colour = nn.Conv2d(c.eighth, 12, 3, padding=1)
        self.up_quarter = nn.Conv2d(c.eighth, 4 * c.quarter, 1)
        self.quarter = Residual(c.quarter)
        self.up_half = nn.Conv2d(c.quarter, 4 * c.half, 1)
        self.fine = Residual(c.half)
        self.pixels = nn.Conv2d(c.half, 16, 3, padding=1)
        zero(self.colour)
        zero(self.pixels)

    def forward(self, tokens, latent, half, quarter, eighth) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Colour coefficients `[B, 12, H/8, W/8]`, residual `[B, 3, H, W]`, gate logits `[B, 1, H, W]`."""
        # Normalised, because a channel that drifts far below zero here is dead for good behind the next activation.
        x = self.eighth(self.norm(F.pixel_shuffle(self.up_eighth(tokens), 2) + self.latent(latent) + eighth))
        coefficients = self.colour(F.silu(x))
        x = self.quarter(F.pixel_shuffle(self.up_quarter(F.silu(x)), 2) + quarter)
        x = self.fine(F.pixel_shuffle(self.up_half(F.silu(x)), 2) + half)
        residual, gate = F.pixel_shuffle(self.pixels(F.silu(x)), 2).split([3, 1], 1)
        return coefficients, residual, gate


def colour_change(rgb: torch.Tensor, coefficients: torch.Tensor) -> torch.Tensor:
    """What the colour field `[B, 12, h, w]` adds to `rgb` `[B, 3, H, W]`: per channel a + b x + c x^2 + d (luma - x)."""
    a, b, c, d = F.interpolate(coefficients, rgb.shape[-2:], mode="bilinear", align_corners=False).chunk(4, 1)
    luma = LUMA[0] * rgb[:, :1] + LUMA[1] * rgb[:, 1:2] + LUMA[2] * rgb[:, 2:]
    return torch.addcmul(a, rgb, b + c * rgb) + d * (luma - rgb)


def hard_gate(logits: torch.Tensor, shut: float | torch.Tensor = SHUT_TRAINING) -> torch.Tensor:
    """A gate in 0..1 that closes exactly: the sigmoid stretched so that it is 0 up to shut / (1 + shut).

    Its gradient ignores the clamp, or a closed gate would never open again.
    """
    soft = torch.sigmoid(logits) * (1 + shut) - shut
    return soft + (soft.clamp(0, 1) - soft).detach() if torch.is_grad_enabled() else soft.clamp(0, 1)


@dataclass(frozen=True)
class Enhanced:
    """What one step gives: the frame `[B, 3, H, W]`, its latent `[B, 16, H/8, W/8]` for the history, the gate's logits `[B, 1, H, W]`,
    and what the frame would be with an open gate `[B, 3, H, W]`."""

    rgb: torch.Tensor
    latent: torch.Tensor
    logits: torch.Tensor
    ungated: torch.Tensor


class Net(nn.Module):
    """The whole network. `encoder` is the autoencoder's and `region_colour` is trained on palettes, both before and then frozen;
    everything else is trained on pairs."""

    def __init__(self, config: NetConfig | None = None):
        super().__init__()
        config = config or NetConfig()
        self.config = config
        self.encoder = Encoder()
        self.stem = Stem(config)
        self.embed = nn.Conv2d(LATENT, config.width, PATCH, stride=PATCH)
        self.age = nn.Parameter(torch.zeros(config.history, config.width))
        self.blocks = nn.ModuleList(Block(config.width, config.heads) for _ in range(config.blocks))
        self.norm = nn.LayerNorm(config.width)
        self.denoise = nn.Conv2d(config.width, LATENT * PATCH**2, 1)
        self.decoder = FrameDecoder(config)
        self.region_colour = RegionColour()
        zero(self.denoise)

    def forward(self, rgb: torch.Tensor, mask: torch.Tensor | None, latents: torch.Tensor, valid: torch.Tensor) -> Enhanced:
        """One frame.

        rgb      `[B, 3, H, W]`, sides multiples of 16
        mask     `[B, 1, H, W]` in 0..1, where inserted or moving objects are; NaN throughout a frame, or None, where unknown
        latents  `[B, K, 16, H/8, W/8]`, K from 0: enhanced before, newest first, already moved to this frame
        valid    `[B, K, 1, H/8, W/8]`: 1 where those were inside the image
        """
        if mask is None:
            mask = rgb.new_full((rgb.shape[0], 1, *rgb.shape[-2:]), torch.nan)
        known = torch.isfinite(mask).to(rgb.dtype)
        frame = torch.cat([rgb * 2 - 1, torch.nan_to_num(mask), known], 1).contiguous(memory_format=torch.channels_last)
        with torch.no_grad():
            latent = self.encoder(rgb.contiguous(memory_format=torch.channels_last))
        half, quarter, eighth, seen = self.stem(frame)
        history, inside = self._history(latents, valid)
        x = (self.embed(latent) + seen).permute(0, 2, 3, 1)
        for block in self.blocks:
            x = block(x, history, inside)
        tokens = self.norm(x).permute(0, 3, 1, 2)
        enhanced = latent - F.pixel_shuffle(self.denoise(tokens), PATCH)
        coefficients, residual, logits = self.decoder(tokens, enhanced, half, quarter, eighth)
        logits = logits.float()
        thin = (..., slice(None, None, 4), slice(None, None, 4))
        with torch.no_grad():
            # Only where the gate is more open than shut: a small region's palette must not drown in a large surrounding's doubts.
            region = (2 * torch.sigmoid(logits[thin]) - 1).clamp_min(0)
            whole = self.region_colour(rgb[thin], region) * (region.sum((2, 3)) / 20).clamp_max(1)
        change = colour_change(rgb.float(), coefficients.float() + whole[:, :, None, None]) + residual.float()
        shut = SHUT_TRAINING if torch.is_grad_enabled() else SHUT_ALONE + (SHUT_TOLD - SHUT_ALONE) * known
        return Enhanced(rgb + hard_gate(logits, shut) * change, enhanced.float(), logits, rgb + change)

    def _history(self, latents: torch.Tensor, valid: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Tokens of the history `[B, K, h, w, C]` and where they may be attended to, bool `[B, K, h, w]`."""
        b, k = latents.shape[:2]
        h, w = latents.shape[-2] // PATCH, latents.shape[-1] // PATCH
        if k == 0:
            return latents.new_zeros(b, 0, h, w, self.config.width), valid.new_zeros(b, 0, h, w, dtype=torch.bool)
        tokens = self.embed(latents.flatten(0, 1)).permute(0, 2, 3, 1).reshape(b, k, h, w, -1) + self.age[:k, None, None]
        return tokens, F.max_pool2d(1 - valid.flatten(0, 1).float(), PATCH).reshape(b, k, h, w) < 0.5
