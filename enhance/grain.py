"""Noise and sharpening that a picture has beyond what others of its place have, and a picture without them.

Both show in its finest detail, what a Gaussian of one pixel takes away: sharpening makes it all larger, noise its many small values most.
So from the mean of its squares and the square of their median, of a picture that has too much of either and of one that has not, both
follow from two linear equations. Noise then goes by Lee's filter (1980), sharpening by what it was multiplied with. What was blurred stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from kornia.filters import gaussian_blur2d
from torch.nn import functional as F

NORMAL = 0.6745**2
"""Square of the median of a normal distribution's absolute values, to its variance."""

AROUND = 5
"""Pixels, across, of a window in which Lee's filter tells detail from noise."""


@dataclass(frozen=True)
class Grain:
    """Of a picture's finest detail, by channel, float64 `[3]`: the mean of its squares, and the square of the median of its size."""

    power: torch.Tensor
    floor: torch.Tensor

    @classmethod
    def of(cls, rgb: torch.Tensor, counts: torch.Tensor | None = None) -> Grain:
        """Of `[H, W, 3]`; of the pixels that count, bool `[H, W]`, all where None."""
        size = _detail(rgb).abs()
        size = size.flatten(1) if counts is None else size[:, counts]
        return cls(size.square().mean(1).double().cpu(), size.median(1).values.square().double().cpu())

    @classmethod
    def mean_of(cls, several: Sequence[Grain]) -> Grain:
        return cls(torch.stack([g.power for g in several]).mean(0), torch.stack([g.floor for g in several]).mean(0))

    def toward(self, other: Grain, share: float) -> Grain:
        return Grain(torch.lerp(self.power, other.power, share), torch.lerp(self.floor, other.floor, share))


@dataclass(frozen=True)
class Excess:
    """By channel, float64 `[3]`: what detail was multiplied with, squared, from 1, and the variance of noise beside it, from 0."""

    gain: torch.Tensor
    noise: torch.Tensor

    @classmethod
    def of(cls, given: Grain, wanted: Grain) -> Excess:
        """power = gain wanted.power + noise, floor = gain wanted.floor + NORMAL noise, solved for both."""
        apart = (wanted.power - wanted.floor / NORMAL).clamp_min(1e-9)
        gain = ((given.power - given.floor / NORMAL) / apart).clamp_min(1)
        return cls(gain, ((given.floor - gain * wanted.floor) / NORMAL).clamp_min(0))

    def beyond(self, usual: Excess) -> Excess:
        """The less of it, the less it is more than usual: none up to there."""
        log, most = self.gain.log(), usual.gain.log()
        surely = (1 - (most / log.clamp_min(1e-9)).square()).clamp_min(0)
        return Excess((surely * log).exp(), self.noise * (1 - usual.noise / self.noise.clamp_min(1e-12)).clamp_min(0))

    def any(self) -> bool:
        return bool((self.gain > 1).any() or (self.noise > 0).any())


def without(rgb: torch.Tensor, excess: Excess) -> torch.Tensor:
    """The picture `[H, W, 3]` without what it has in excess, cut to 0..1."""
    detail = _detail(rgb)
    gain, noise = (x.to(detail)[:, None, None] for x in (excess.gain, excess.noise))
    half = AROUND // 2
    power = F.avg_pool2d(F.pad(detail.square()[None], (half, half, half, half), mode="replicate"), AROUND, 1)[0]
    kept = (power - noise).clamp_min(0) / power.clamp_min(1e-12) / gain.sqrt()
    return (rgb + ((kept - 1) * detail).permute(1, 2, 0)).clamp(0, 1)


def _detail(rgb: torch.Tensor) -> torch.Tensor:
    """`[3, H, W]` of `[H, W, 3]`."""
    image = rgb.permute(2, 0, 1)[None]
    return (image - gaussian_blur2d(image, (5, 5), (1.0, 1.0), border_type="replicate"))[0]
