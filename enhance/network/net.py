"""The enhancer's network: a single-step latent transformer between a frozen encoder and a decoder that sees the frame.

It repairs what a reconstruction shows badly. After DiffusionHarmonizer, small. The clean latent goes through the transformer once, at a
fixed timestep and without text; because both never change, what their embeddings would add to every layer is stored as constants
(`Modulation`). Spatial attention alternates with temporal attention over the latents of up to `history` frames enhanced before. The decoder
gets features of the input frame, of what photos said of it, and of the last enhanced one moved to it, at every scale, and the output is

    output = input + residual + blend * (last - input)

Told objects come here in corrected colours (`ObjectNet`), and what photos show is laid in already (`render/references.py`). The residual is
free; blending with the last picture keeps a clip calm. Both are zero in an untrained network, which therefore changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from enhance.correcting.objects import ObjectNet
from enhance.network.attention import Block
from enhance.network.autoencoder import LATENT, STRIDE, Encoder, Residual, on_blocks, zero
from enhance.network.past import Past
from enhance.network.precision import lower
from enhance.tiles import Tiles, coarser, within

PATCH = 2  # latents per token side
MULTIPLE = STRIDE * PATCH  # a frame's sides are padded to multiples of this
PHOTOS = 4
"""Channels of what photos say: colours, and how far they are trusted."""
FRAME_CHANNELS = 3 + 2 + 4 + PHOTOS  # colours; the mask, and whether there is one; the last picture, and where it is seen; photos


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
        self.pixels = nn.Conv2d(c.half, 4 * 4, 3, padding=1)
        zero(self.pixels)

    def forward(self, tokens, latent, half, quarter, eighth) -> tuple[torch.Tensor, ...]:
        """Residual `[B, 3, H, W]`, and logits of the blend `[B, 1, H, W]`."""
        # Normalised, because a channel that drifts far below zero here is dead for good behind the next activation.
        x = self.norm(F.pixel_shuffle(self.up_eighth(tokens), 2) + self.latent(latent) + eighth)
        x = self.eighth(x)
        x = self.quarter(F.pixel_shuffle(self.up_quarter(F.silu(x)), 2) + quarter)
        x = self.fine(F.pixel_shuffle(self.up_half(F.silu(x)), 2) + half)
        return F.pixel_shuffle(self.pixels(F.silu(x)), 2).float().split([3, 1], 1)


def blend_of(logits: torch.Tensor) -> torch.Tensor:
    """A share in 0..1 that is exactly 0 up to logits of 0: the sigmoid, stretched. Its gradient ignores the clamp, or what is 0 would stay
    so."""
    soft = 2 * torch.sigmoid(logits) - 1
    return soft + (soft.clamp(0, 1) - soft).detach() if torch.is_grad_enabled() else soft.clamp(0, 1)


def photos_of(reference: torch.Tensor, trust: torch.Tensor) -> torch.Tensor:
    """What photos say `[B, 3, H, W]` and how far that is trusted `[B, 1, H, W]`, as the network takes it `[B, PHOTOS, H, W]`."""
    return torch.cat([(reference * 2 - 1) * (trust > 0), trust], 1)


@dataclass(frozen=True)
class Enhanced:
    """What one step gives.

    rgb     `[B, 3, H, W]`: the frame
    latent  `[B, 16, H/8, W/8]`: the enhanced frame's
    past    what the next frame is given, still to be moved there
    """

    rgb: torch.Tensor
    latent: torch.Tensor
    past: Past


class Net(nn.Module):
    """The whole network. `encoder` is the autoencoder's, `objects` is trained on objects, both before and then frozen; everything else is
    trained on pairs."""

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
        zero(self.denoise)

    def forward(
        self, rgb: torch.Tensor, mask: torch.Tensor | None = None, past: Past | None = None, photos: torch.Tensor | None = None
    ) -> Enhanced:
        """One frame.

        rgb     `[B, 3, H, W]`, sides multiples of 16
        mask    `[B, 1, H, W]`, above 0 where inserted or moving objects are, their colours corrected (`enhance.correcting`); NaN
                throughout a frame, or None, where unknown
        past    of the frames before, already moved to this one; None at the start
        photos  `photos_of` what was laid into rgb; None where nothing was
        """
        past = past or Past.none(rgb)
        better, latent = self.repair(rgb, told_of(rgb, mask), past, _or_no(photos, rgb))
        return Enhanced(better, latent, past.followed(better, latent, self.config.history))

    def repair(self, rgb: torch.Tensor, told: torch.Tensor, past: Past, photos: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """A frame or a window of it: picture and latent, as in `Enhanced`."""
        last = past.rgb * past.seen
        # the convolutions round their input to their own precision anyway: once before it is shuffled is less to move
        frame = torch.cat([lower(x) for x in (rgb * 2 - 1, told, last * 2 - past.seen, past.seen, photos)], 1)
        with torch.no_grad():
            latent = self.encoder(rgb)
        half, quarter, eighth, seen = self.stem(frame)
        history, inside = self._history(past)
        x = (self.embed(latent) + seen).permute(0, 2, 3, 1)
        for block in self.blocks:
            x = block(x, history, inside)
        tokens = self.norm(x).permute(0, 3, 1, 2)
        enhanced = latent - F.pixel_shuffle(self.denoise(tokens), PATCH)
        residual, blend = self.decoder(tokens, enhanced, half, quarter, eighth)
        given = rgb.float()
        return given + residual + blend_of(blend) * past.seen * (last - given), enhanced.float()

    @torch.no_grad()
    def parts(
        self, rgb: torch.Tensor, mask: torch.Tensor | None, past: Past | None, photos: torch.Tensor | None, tiles: Tiles
    ) -> tuple[torch.Tensor, Past]:
        """One frame `[1, 3, H, W]`, worked on in the windows around `tiles` only: the picture and its past. Other tiles stay exactly as
        they are, and nothing of them is remembered but the picture."""
        past = past or Past.none(rgb)
        told, photos = told_of(rgb, mask), _or_no(photos, rgb)
        height, width = rgb.shape[-2:]
        better, pixels = rgb.clone(), F.pad(tiles.pixels(), (0, width - tiles.width, 0, height - tiles.height))
        latent = rgb.new_zeros(1, LATENT, height // STRIDE, width // STRIDE)
        known = latent[:, :1].clone()
        for window, core in tiles.windows():
            y, x = within(window, height, width)
            picture, found = self.repair(rgb[..., y, x], told[..., y, x], past.cropped((y, x)), photos[..., y, x])
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


def _or_no(photos: torch.Tensor | None, rgb: torch.Tensor) -> torch.Tensor:
    return rgb.new_zeros(rgb.shape[0], PHOTOS, *rgb.shape[-2:]) if photos is None else photos
