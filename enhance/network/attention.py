"""Transformer layers over the tokens of a frame and of the frames before it."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

from enhance.network.precision import lower


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
        x = lower(x)  # as its layers would, each for itself
        seen = torch.cat([x[:, None], history.to(x.dtype)], 1)
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


class SpatialBlock(nn.Module):
    """Spatial attention and perceptron, each behind its modulation: tokens `[B, h, w, C]`."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.spatial, self.perceptron = SpatialAttention(width, heads), Perceptron(width)
        self.before_spatial, self.before_perceptron = Modulation(width), Modulation(width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = x + self.before_spatial.gate * self.spatial(self.before_spatial(x))
        return x + self.before_perceptron.gate * self.perceptron(self.before_perceptron(x))


class Block(nn.Module):
    """Temporal attention behind its modulation, then a spatial block."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.temporal, self.before_temporal = TemporalAttention(width, heads), Modulation(width)
        self.space = SpatialBlock(width, heads)

    def forward(self, x: torch.Tensor, history: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
        return self.space(x + self.before_temporal.gate * self.temporal(self.before_temporal(x), history, valid))
