"""The six white-box filters of Ke et al., Harmonizer (ECCV 2022; ZHKKKe/Harmonizer, filter.py), each with one argument in -1..1.

Images are `[B, 3, H, W]`, display-referred, 0..1; arguments `[B]`, 0 leaves a picture as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

EPS = 1e-6


def temperature(image: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Colder below 0, warmer above: gains towards grey of means that red (x < 0) or blue (x > 0), and half as much green, are added to."""
    mean = image.mean((2, 3), keepdim=True)
    share = torch.stack([(x < 0).to(image), 0.5 * (x != 0).to(image), (x > 0).to(image)], 1)[..., None, None]
    moved = mean + x.abs()[:, None, None, None] * share
    gain = moved.mean(1, keepdim=True) / (moved + EPS) + 1 - mean.mean(1, keepdim=True) / (mean + EPS)
    return (gain * image).clamp(0, 1)


def brightness(image: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """The value of hue, saturation and value scaled by 1 + x below 0, by 1 / (1 - x) above: all three channels alike."""
    return (image * torch.where(x < 0, 1 + x, 1 / (1 - x + EPS))[:, None, None, None]).clamp(0, 1)


def contrast(image: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Spread about the mean of the picture by 1 + x below 0, by 255 / (256 - floor(255 x)) above."""
    spread = torch.where(x > 0, 255 / (256 - torch.floor(255 * x)) - 1, x)[:, None, None, None]
    return (image + (image - image.mean((1, 2, 3), keepdim=True)) * spread).clamp(0, 1)


def saturation(image: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Spread about each pixel's lightness: by 1 + x below 0, above by as much more as x or its own saturation allows."""
    low, high = image.amin(1, keepdim=True), image.amax(1, keepdim=True)
    middle, x = (low + high) / 2, x[:, None, None, None]
    own = (high - low) / (torch.where(middle < 0.5, high + low, 2 - high - low) + EPS)
    more = (image - middle) * (1 / (torch.where(x + own > 1, own, 1 - x) + EPS) - 1)
    return torch.where(x < 0, middle + (image - middle) * (1 + x), image + more).clamp(0, 1)


def highlight(image: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Gamma of 1 + x seen from white: brighter above 0."""
    return 1 - (1 - image + 1e-9).pow(1 + x[:, None, None, None]).clamp(0, 1)


def shadow(image: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Gamma of 1 - x: brighter above 0."""
    return (image + 1e-9).pow(1 - x[:, None, None, None]).clamp(0, 1)


FILTERS: tuple[Callable[[torch.Tensor, torch.Tensor], torch.Tensor], ...] = (
    temperature,
    brightness,
    contrast,
    saturation,
    highlight,
    shadow,
)
"""In the order in which they are applied."""


def harmonized(image: torch.Tensor, mask: torch.Tensor, arguments: Sequence[torch.Tensor]) -> torch.Tensor:
    """The image with all filters, each on the whole picture that the one before left, inside `mask` `[B, 1, H, W]`; itself elsewhere."""
    out = image
    for change, x in zip(FILTERS, arguments, strict=True):
        out = change(out, x.clamp(-1, 1))
    return out * mask + image * (1 - mask)
