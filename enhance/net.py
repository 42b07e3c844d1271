"""The enhancer's network: a single-step latent transformer between a frozen encoder and a decoder that sees the frame.

After DiffusionHarmonizer, small. The clean latent goes through the transformer once, at a fixed timestep and without text;
because both never change, what their embeddings would add to every layer is stored as constants (`Modulation`). Spatial
attention alternates with temporal attention over the latents of up to `history` frames enhanced before. The decoder gets
features of the input frame, and of the last enhanced one moved to it, at every scale, and the output is

    output = input + gate * (residual + blend * (last - input))

Told objects come here in corrected colours (`ObjectNet`). The residual is free; blending with the last picture keeps a clip calm; the
gate is exactly 0 where the frame is to be left alone. Residual and blend are zero in an untrained network, which therefore changes
nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from enhance.attention import Block
from enhance.autoencoder import LATENT, STRIDE, Encoder, Residual, on_blocks, zero
from enhance.objects import ObjectNet
from enhance.past import Past
from enhance.precision import lower
from enhance.tiles import Tiles, coarser, within

PATCH = 2  # latents per token side
MULTIPLE = STRIDE * PATCH  # a frame's sides are padded to multiples of this
SHUT_TRAINING = 0.1  # see hard_gate
FRAME_CHANNELS = 3 + 2 + 4  # colours; the mask, and whether there is one; the last picture, and where it is seen


@dataclass(frozen=True)
class NetConfig:
    """Sizes of the network; stored with its weights."""

    width: int = 192
    """Channels of a token."""
    blocks: int = 4
    """Transformer blocks: temporal attention, spatial attention, perceptron."""
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
    looks: int = 96
    """Channels of what is read of an object; a multiple of 4."""


def told_of(rgb: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """A mask or objects' ids `[B, 1, H, W]`, NaN or None where unknown, as the network takes it: where it is above 0, and whether it is
    known `[B, 2, H, W]`."""
    if mask is None:
        return rgb.new_zeros(rgb.shape[0], 2, *rgb.shape[-2:])
    return torch.cat([mask > 0, torch.isfinite(mask)], 1).to(rgb.dtype)


class Stem(nn.Module):
    """Trainable features of the input frame, mask and last picture at 1/2, 1/4, 1/8 of the size and as tokens at 1/16."""

    def __init__(self, c: NetConfig):
        super().__init__()
        self.fine = nn.Conv2d(4 * FRAME_CHANNELS, c.half, 3, padding=1)
        self.quarter = nn.Conv2d(c.half, c.quarter, 3, stride=2, padding=1)
        self.quarter_block = Residual(c.quarter)
        self.eighth = nn.Conv2d(c.quarter, c.eighth, 3, stride=2, padding=1)
        self.eighth_block = Residual(c.eighth)
        self.token = nn.Conv2d(c.eighth, c.width, 2, stride=2)

    def forward(self, frame: torch.Tensor) -> tuple[torch.Tensor, ...]:
        half = F.silu(on_blocks(self.fine, frame, 2))
        quarter = self.quarter_block(self.quarter(half))
        eighth = self.eighth_block(self.eighth(F.silu(quarter)))
        return half, quarter, eighth, self.token(F.silu(eighth))


class FrameDecoder(nn.Module):
    """Tokens and the input frame's features to what is done to each pixel."""

    def __init__(self, c: NetConfig):
        super().__init__()
        self.up_eighth = nn.Conv2d(c.width, 4 * c.eighth, 1)
        self.latent = nn.Conv2d(LATENT, c.eighth, 3, padding=1)
        self.norm = nn.GroupNorm(1, c.eighth)
        self.eighth = Residual(c.eighth)
        self.up_quarter = nn.Conv2d(c.eighth, 4 * c.quarter, 1)
        self.quarter = Residual(c.quarter)
        self.up_half = nn.Conv2d(c.quarter, 4 * c.half, 1)
        self.fine = Residual(c.half)
        self.pixels = nn.Conv2d(c.half, 4 * 5, 3, padding=1)
        zero(self.pixels)

    def forward(self, tokens, latent, half, quarter, eighth) -> tuple[torch.Tensor, ...]:
        """Residual `[B, 3, H, W]`, and logits of gate and blend `[B, 1, H, W]`."""
        # Normalised, because a channel that drifts far below zero here is dead for good behind the next activation.
        x = self.norm(F.pixel_shuffle(self.up_eighth(tokens), 2) + self.latent(latent) + eighth)
        x = self.eighth(x)
        x = self.quarter(F.pixel_shuffle(self.up_quarter(F.silu(x)), 2) + quarter)
        x = self.fine(F.pixel_shuffle(self.up_half(F.silu(x)), 2) + half)
        return F.pixel_shuffle(self.pixels(F.silu(x)), 2).float().split([3, 1, 1], 1)


def hard_gate(logits: torch.Tensor, shut: float | torch.Tensor = SHUT_TRAINING) -> torch.Tensor:
    """A gate in 0..1 that closes exactly: the sigmoid stretched so that it is 0 up to shut / (1 + shut).

    Its gradient ignores the clamp, or a closed gate would never open again.
    """
    soft = torch.sigmoid(logits) * (1 + shut) - shut
    return soft + (soft.clamp(0, 1) - soft).detach() if torch.is_grad_enabled() else soft.clamp(0, 1)


def of_mask(pair: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """The first of two numbers where no mask is known, the second where one is: known `[B, 1, H, W]`, 0 or 1."""
    return pair[0] + (pair[1] - pair[0]) * known


@dataclass(frozen=True)
class Enhanced:
    """What one step gives.

    rgb      `[B, 3, H, W]`: the frame
    logits   `[B, 1, H, W]`: of the gate
    ungated  `[B, 3, H, W]`: what the frame would be with an open gate
    latent   `[B, 16, H/8, W/8]`: the enhanced frame's
    past     what the next frame is given, still to be moved there
    """

    rgb: torch.Tensor
    logits: torch.Tensor
    ungated: torch.Tensor
    latent: torch.Tensor
    past: Past


class Net(nn.Module):
    """The whole network. `encoder` is the autoencoder's, `objects` is trained on objects, both before and then frozen; everything else is
    trained on pairs. `shut` says how far the gate must be open to count, without a mask and with one: it is set in training
    (`enhance.calibrate`)."""

    shut: torch.Tensor

    def __init__(self, config: NetConfig | None = None):
        super().__init__()
        config = config or NetConfig()
        self.config = config
        self.encoder = Encoder()
        self.objects = ObjectNet(config.looks)
        self.stem = Stem(config)
        self.embed = nn.Conv2d(LATENT, config.width, PATCH, stride=PATCH)
        self.age = nn.Parameter(torch.zeros(config.history, config.width))
        self.blocks = nn.ModuleList(Block(config.width, config.heads) for _ in range(config.blocks))
        self.norm = nn.LayerNorm(config.width)
        self.denoise = nn.Conv2d(config.width, LATENT * PATCH**2, 1)
        self.decoder = FrameDecoder(config)
        self.register_buffer("shut", torch.tensor([0.5, 0.5]))
        zero(self.denoise)

    def forward(self, rgb: torch.Tensor, mask: torch.Tensor | None = None, past: Past | None = None) -> Enhanced:
        """One frame.

        rgb   `[B, 3, H, W]`, sides multiples of 16
        mask  `[B, 1, H, W]`, above 0 where inserted or moving objects are, their colours corrected (`enhance.corrections`); NaN
              throughout a frame, or None, where unknown
        past  of the frames before, already moved to this one; None at the start
        """
        past = past or Past.none(rgb)
        told = told_of(rgb, mask)
        better, logits, ungated, latent = self.repair(rgb, told, past)
        after = past.followed(better, latent, self.config.history)
        return Enhanced(better, logits, ungated, latent, after)

    def repair(self, rgb: torch.Tensor, told: torch.Tensor, past: Past) -> tuple[torch.Tensor, ...]:
        """A frame or a window of it: picture, logits, ungated and latent, as in `Enhanced`."""
        known = told[:, 1:]
        last = past.rgb * past.seen
        # the convolutions round their input to their own precision anyway: once before it is shuffled is less to move
        frame = torch.cat([lower(x) for x in (rgb * 2 - 1, told, last * 2 - past.seen, past.seen)], 1)
        with torch.no_grad():
            latent = self.encoder(rgb)
        half, quarter, eighth, seen = self.stem(frame)
        history, inside = self._history(past)
        x = (self.embed(latent) + seen).permute(0, 2, 3, 1)
        for block in self.blocks:
            x = block(x, history, inside)
        tokens = self.norm(x).permute(0, 3, 1, 2)
        enhanced = latent - F.pixel_shuffle(self.denoise(tokens), PATCH)
        residual, logits, blend = self.decoder(tokens, enhanced, half, quarter, eighth)
        enhanced = enhanced.float()
        given = rgb.float()
        ungated = given + residual + hard_gate(blend, 1.0) * past.seen * (last - given)
        shut = SHUT_TRAINING if torch.is_grad_enabled() else of_mask(self.shut, known)
        better = given + hard_gate(logits, shut) * (ungated - given)
        return better, logits, ungated, enhanced

    @torch.no_grad()
    def parts(self, rgb: torch.Tensor, mask: torch.Tensor | None, past: Past | None, tiles: Tiles) -> tuple[torch.Tensor, Past]:
        """One frame `[1, 3, H, W]`, worked on in the windows around `tiles` only: the picture and its past. Other tiles stay exactly as
        they are, and nothing of them is remembered but the picture."""
        past = past or Past.none(rgb)
        told = told_of(rgb, mask)
        height, width = rgb.shape[-2:]
        better, pixels = rgb.clone(), F.pad(tiles.pixels(), (0, width - tiles.width, 0, height - tiles.height))
        latent = rgb.new_zeros(1, LATENT, height // STRIDE, width // STRIDE)
        known = latent[:, :1].clone()
        for window, core in tiles.windows():
            y, x = within(window, height, width)
            picture, _, _, found = self.repair(rgb[..., y, x], told[..., y, x], past.cropped((y, x)))
            v, u = within(core, height, width)
            inner = slice(v.start - y.start, v.stop - y.start), slice(u.start - x.start, u.stop - x.start)
            better[..., v, u] = torch.where(pixels[v, u].to(rgb.device), picture[..., inner[0], inner[1]], rgb[..., v, u])
            rows, columns = coarser((v, u), STRIDE)
            part = coarser(inner, STRIDE)
            latent[..., rows, columns], known[..., rows, columns] = found[..., part[0], part[1]], 1
        return better, past.followed(better, latent, self.config.history, known)

    def _history(self, past: Past) -> tuple[torch.Tensor, torch.Tensor]:
        """Tokens of the latents `[B, K, h, w, C]` and where they may be attended to, bool `[B, K, h, w]`."""
        b, k = past.latents.shape[:2]
        h, w = past.latents.shape[-2] // PATCH, past.latents.shape[-1] // PATCH
        if k == 0:
            return past.latents.new_zeros(b, 0, h, w, self.config.width), past.valid.new_zeros(b, 0, h, w, dtype=torch.bool)
        tokens = self.embed(past.latents.flatten(0, 1)).permute(0, 2, 3, 1).reshape(b, k, h, w, -1) + self.age[:k, None, None]
        return lower(tokens), F.max_pool2d(1 - past.valid.flatten(0, 1).float(), PATCH).reshape(b, k, h, w) < 0.5
