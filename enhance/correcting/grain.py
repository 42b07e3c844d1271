"""Noise and sharpening that a picture has beyond what others of its place have, and a picture without them.

Both show in its finest detail, what a Gaussian of one pixel takes away: sharpening makes it all larger, noise its many small values most.
So from the mean of its squares and the square of their median, of a picture that has too much of either and of one that has not, both
follow from two linear equations. Noise then goes by Lee's filter (1980), sharpening by its inverse. What was blurred stays. Of objects only
sharpening is told so: their noise is measured by itself (`enhance.correcting.noise`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from kornia.filters import gaussian_blur2d
from torch.nn import functional as F

from enhance.averaged import Averaged

NORMAL = 0.6745**2
"""Square of the median of a normal distribution's absolute values, to its variance."""

AROUND = 5
"""Pixels, across, of a window in which Lee's filter tells detail from noise."""

ROUNDING = (0.3 / 255) ** 2
"""Variance of noise that pictures of bytes have anyway."""

FEWEST = 1000
"""Pixels that tell the grain of an object, or of what is around it."""

KEPT_FINE, KEPT_COARSE = 0.8, 0.22
"""Part of what sharpening by a Gaussian of one pixel adds again, of the finest detail and of the next."""

FLAT, ROUGH, ALL = 0.125, 2.0, 0.5
"""An object's floor, to its power and to the floor around it, up to which it is its texture; and to its power at most."""

MOST = 9.0
"""Times that sharpening multiplies the power of finest detail at most."""

STEPS = 6
"""In which sharpening is undone: of the strongest 0.6 to this power is left where it did least."""

USUAL_GAIN = 1.25
"""Gain that right objects seem to have beside what is around them, nine of ten up to there."""


@dataclass(frozen=True)
class Grain(Averaged):
    """Of a picture's finest detail, by channel, float64 `[3]`: the mean of its squares, and the square of the median of its size."""

    power: torch.Tensor
    floor: torch.Tensor

    @classmethod
    def of(cls, rgb: torch.Tensor, counts: torch.Tensor | None = None) -> Grain:
        """Of `[H, W, 3]`; of the pixels that count, bool `[H, W]`, all where None."""
        detail = _detail(rgb)
        return cls.of_detail(detail.flatten(1) if counts is None else detail[:, counts])

    @classmethod
    def of_detail(cls, detail: torch.Tensor) -> Grain:
        """Of `[3, N]`."""
        return cls(detail.square().mean(1).double().cpu(), detail.abs().median(1).values.square().double().cpu())


@dataclass(frozen=True)
class Excess:
    """By channel, float64 `[3]`: what detail was multiplied with, squared, from 1, and the variance of noise beside it, from 0."""

    gain: torch.Tensor
    noise: torch.Tensor

    @classmethod
    def of(cls, given: Grain, wanted: Grain) -> Excess:
        """power = gain wanted.power + noise, floor = gain wanted.floor + NORMAL noise, solved for both."""
        apart = (wanted.power - wanted.floor / NORMAL).clamp_min(1e-9)
        gain = ((given.power - given.floor / NORMAL) / apart).clamp(1, MOST)
        noise = (given.floor - gain * wanted.floor) / NORMAL
        return cls(gain, torch.where(noise > ROUNDING, noise, 0.0))

    def beyond(self, usual: Excess) -> Excess:
        """The less of it, the less it is more than usual: none up to there."""
        log, most = self.gain.log(), usual.gain.log()
        surely = (1 - (most / log.clamp_min(1e-9)).square()).clamp_min(0)
        return Excess((surely * log).exp(), self.noise * (1 - usual.noise / self.noise.clamp_min(1e-12)).clamp_min(0))

    def any(self) -> bool:
        return bool((self.gain > 1).any() or (self.noise > 0).any())


def of_object(rgb: torch.Tensor, mask: torch.Tensor, around: torch.Tensor) -> tuple[Grain, Grain] | None:
    """The grain of an object, bool `[h, w]`, in a picture `[h, w, 3]`, and what it should be by what is `around` it; None where too little
    tells. How much finest detail there is to the next coarser is the camera's; how much of that, the object's."""
    inner = F.max_pool2d((~mask)[None, None].float(), AROUND, 1, AROUND // 2)[0, 0] == 0
    if int(inner.sum()) < FEWEST or int(around.sum()) < FEWEST:
        return None
    fine = _detail(rgb)
    image = (rgb.permute(2, 0, 1) - fine)[None]
    coarse = (image - gaussian_blur2d(image, (9, 9), (2.0, 2.0), border_type="replicate"))[0]
    given, beside = Grain.of_detail(fine[:, inner]), Grain.of_detail(fine[:, around])
    mine, theirs = (coarse[:, where].square().mean(1).double().cpu().clamp_min(1e-9) for where in (inner, around))
    power = mine * beside.power / theirs
    root = (given.power / power.clamp_min(1e-9)).sqrt().clamp(1, 3)
    power = power / (1 + KEPT_COARSE * (root - 1) / (KEPT_FINE - KEPT_COARSE * root)).square()
    floor = torch.maximum(FLAT * NORMAL * power, ROUGH * beside.floor)
    return given, Grain(power, torch.minimum(floor, ALL * NORMAL * power))


def sharpening(given: Grain, wanted: Grain) -> float:
    """How much of what a Gaussian of one pixel takes from an object was added to it beyond what is usual (`Isp.sharpen`): the mean of its
    channels, which cameras sharpen alike."""
    usual = Excess(torch.full_like(given.power, USUAL_GAIN), torch.zeros_like(given.power))
    return (float(Excess.of(given, wanted).beyond(usual).gain.sqrt().mean()) - 1) / KEPT_FINE


def without(rgb: torch.Tensor, excess: Excess) -> torch.Tensor:
    """The picture `[H, W, 3]` without what it has in excess, cut to 0..1."""
    gain, noise = (x.to(rgb) for x in (excess.gain, excess.noise))
    soft = unsharpened(rgb, (gain.sqrt() - 1) / KEPT_FINE)
    detail, half = _detail(soft), AROUND // 2
    power = F.avg_pool2d(F.pad(detail.square()[None], (half, half, half, half), mode="replicate"), AROUND, 1)[0]
    kept = (power - (noise / gain)[:, None, None]).clamp_min(0) / power.clamp_min(1e-12)
    return (soft + ((kept - 1) * detail).permute(1, 2, 0)).clamp(0, 1)


def unsharpened(rgb: torch.Tensor, amount: torch.Tensor) -> torch.Tensor:
    """The picture `[H, W, 3]` that with `amount` `[3]` of what a Gaussian of one pixel takes from it is this one, by Richardson's steps."""
    if not (amount > 0).any():
        return rgb
    was = rgb
    for _ in range(STEPS):
        was = was + (rgb - was - amount * _detail(was).permute(1, 2, 0)) / (1 + amount)
    return was


def _detail(rgb: torch.Tensor) -> torch.Tensor:
    """`[3, H, W]` of `[H, W, 3]`."""
    image = rgb.permute(2, 0, 1)[None]
    return (image - gaussian_blur2d(image, (5, 5), (1.0, 1.0), border_type="replicate"))[0]
