"""The shadow that an object lacks: how much darker the ground around it should be, on a small grid that goes with its box.

Where an object meets the ground, and how far its shadow reaches, is much the same for every car once places are measured in boxes, so
a few numbers tell it: optical depths at knots that are dense along the object's base, between which hats interpolate. Whether it is
missing, the brightness of the ground at the same knots tells.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import nn

from scenes.sky import linear_from_srgb, srgb_from_linear

DOWN = (-0.4, 0.2, 0.6, 0.9, 1.1, 1.4, 2.0)
"""Heights in the box of the knots, -1 its top and 1 its base; at the first and the last there is no shadow."""
ACROSS = (-2.2, -1.6, -1.1, -0.6, -0.2, 0.2, 0.6, 1.1, 1.6, 2.2)
"""The same across the box, -1 its left and 1 its right side."""
KNOTS = (len(DOWN) - 2) * (len(ACROSS) - 2)
NONE = 0.02
"""Optical depth up to which the ground stays as it is."""


READ = 3 * KNOTS
SEEN = 4096
"""Most pixels of the ground that are read."""
DARKEST = 3e-3


class ShadeNet(nn.Module):
    """What `read_ground` reads of objects `[B, READ]` to optical depths `[B, KNOTS]` of the shadows that they lack; zero at first."""

    def __init__(self, width: int = 64):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(READ, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, KNOTS))
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, read: torch.Tensor) -> torch.Tensor:
        return self.layers(read).float()


def read_ground(rgb: torch.Tensor, places: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """Of sRGB `[B, N, 3]` of ground at `places` `[B, N, 2]` by B objects, where it is known `[B, N]`: by knot the mean logarithm of its
    light against the median, its spread, and how much of the ground is there, `[B, READ]`."""
    if not places.shape[1]:
        return rgb.new_zeros(len(rgb), READ)
    near = known & (places[..., 0] > DOWN[0])
    light = torch.log(linear_from_srgb(rgb).mean(-1) + DARKEST)
    light = (light - light.where(near, torch.nan).nanmedian(1, keepdim=True).values).where(near, 0.0)
    down, across = (_hats(places[..., i], knots) for i, knots in enumerate((DOWN, ACROSS)))
    sums = torch.einsum("vbn,bnd,bnk->vbdk", torch.stack([near.to(light), light, light.square()]), down, across).flatten(2)
    counts, mean, square = *sums[:1], *(sums[1:] / sums[0].clamp_min(1e-6))
    there = counts > 2
    spread = (square - mean.square()).clamp_min(0).sqrt()
    share = counts / near.sum(1, keepdim=True).clamp_min(1)
    return torch.cat([mean * there, spread * there, (share * 20).clamp_max(2)], 1)


def at_most(most: int, count: int, device: torch.device) -> torch.Tensor:
    """Indices of `most` of `count`, evenly spaced; of all where they are no more."""
    kept = min(most, count)
    return torch.arange(kept, device=device) * count // max(1, kept)


def optical_depth(places: torch.Tensor, depths: torch.Tensor) -> torch.Tensor:
    """At places `[B, N, 2]` (down and across the box) between the knots' `depths` `[B, KNOTS]`: `[B, N]`; of a trained network's it may
    be a little below 0."""
    down, across = (_hats(places[..., i], knots) for i, knots in enumerate((DOWN, ACROSS)))
    grid = depths.unflatten(-1, (down.shape[-1], across.shape[-1]))
    return torch.einsum("bnd,bdk,bnk->bn", down, grid, across)


def optical_depths(y: torch.Tensor, x: torch.Tensor, depths: torch.Tensor) -> torch.Tensor:
    """The same of one object `[KNOTS]` at all places of rows `y` `[h]` and columns `x` `[w]` of its box: `[h, w]`."""
    down, across = _hats(y, DOWN), _hats(x, ACROSS)
    return down @ depths.unflatten(0, (down.shape[1], across.shape[1])) @ across.T


def shaded(rgb: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
    """sRGB `[..., 3]` behind an optical depth `[...]`: light times exp(-depth)."""
    return srgb_from_linear(linear_from_srgb(rgb.clamp(0, 1)) * torch.exp(-depth)[..., None])


@lru_cache(maxsize=8)
def _neighbours(knots: tuple[float, ...], device: torch.device) -> tuple[torch.Tensor, ...]:
    """For each inner knot the one before, itself and the one after: kept, for they are asked for many times a picture."""
    return tuple(torch.tensor(knots[i : len(knots) - 2 + i], device=device) for i in range(3))


def _hats(x: torch.Tensor, knots: tuple[float, ...]) -> torch.Tensor:
    """How much each inner knot counts at `x` `[...]`: 1 there, falling to 0 at its neighbours, `[..., len(knots) - 2]`."""
    before, at, after = _neighbours(knots, x.device)
    x = x[..., None]
    return torch.minimum((x - before) / (at - before), (after - x) / (after - at)).clamp_min(0)
