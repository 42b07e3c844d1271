"""A photo's noise, told from what splats do not explain of it: at night that is mostly noise, and would be brought into every view.

Where a photo shows least that splats do not, its difference to them is noise alone: how strong it is at which brightness is the lower
envelope of the spread of small squares (Liu et al. 2008, who ask the photo itself). In sRGB it is the weaker the brighter a picture is,
gamma being steepest in the dark, so what seems more than that of the dark is texture. A difference keeps of itself as much as is more than
noise around (Lee 1980).
"""

from __future__ import annotations

import torch
from torch.nn import functional as F

SIDE = 8
"""Pixels of a square's side."""

FLATTEST = 0.1
"""Part of the squares of one brightness that show nothing but noise."""

BRIGHTNESSES, FEWEST = 8, 40
"""Brightnesses that are told apart, and squares that must have one for its noise to be told."""

CLIPPED = 1 / 255
"""How near to black or white a picture clips, and its noise with it."""

AROUND = 5
"""Pixels across in which a difference is compared with the noise."""


def without_noise(difference: torch.Tensor, photo: torch.Tensor) -> torch.Tensor:
    """What a photo `[H, W, 3]` (sRGB, 0..1) shows more than splats do, `[H, W, 3]`, less what may be its noise."""
    noise = noise_of(difference, photo)
    if noise is None:
        return difference
    at = (_means(photo, SIDE + 1) * len(noise) - 0.5).clamp(0, len(noise) - 1)
    darker = at.long().clamp_max(len(noise) - 2)
    here = torch.lerp(noise[darker], noise[darker + 1], at - darker)
    there = _means(difference.square(), AROUND)
    return difference * (1 - here / there.clamp_min(1e-12)).clamp_min(0)[..., None]


def noise_of(difference: torch.Tensor, photo: torch.Tensor) -> torch.Tensor | None:
    """Variance `[BRIGHTNESSES]` of a photo's noise, from black to white, never more than where it is darker; None where no brightness has
    squares enough. As of `without_noise`."""
    differs, shown = _squares(difference), _squares(photo)
    if len(differs) < FEWEST:
        return None
    clipped = (shown < CLIPPED).any(1).all(1) | (shown > 1 - CLIPPED).any(1).any(1)
    spread, level = differs.var(1).mean(1)[~clipped], (shown.mean((1, 2)) * BRIGHTNESSES)[~clipped].long()
    told = spread.new_full((BRIGHTNESSES,), torch.inf)
    for k in range(BRIGHTNESSES):
        own = spread[level == k]
        if len(own) >= FEWEST:
            told[k] = own.quantile(FLATTEST)
    least = told.cummin(0).values
    known = least[least.isfinite()]
    return torch.where(least.isfinite(), least, known[0]) if len(known) else None


def _squares(picture: torch.Tensor) -> torch.Tensor:
    """The whole squares of a picture `[H, W, 3]`, `[N, SIDE**2, 3]`."""
    down, across = (n // SIDE for n in picture.shape[:2])
    whole = picture[: down * SIDE, : across * SIDE].reshape(down, SIDE, across, SIDE, 3)
    return whole.transpose(1, 2).reshape(-1, SIDE * SIDE, 3)


def _means(picture: torch.Tensor, side: int) -> torch.Tensor:
    """Means `[H, W]` of a picture `[H, W, 3]` over its channels, and squares of a side around."""
    return F.avg_pool2d(picture.mean(-1)[None, None], side, 1, side // 2, count_include_pad=False)[0, 0]
