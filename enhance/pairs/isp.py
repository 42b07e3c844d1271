"""What a camera's image pipeline can do to a picture, in linear light: the damage that harmonization undoes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from kornia.filters import gaussian_blur2d

from scenes.sky import LUMINANCE

FLOOR = 0.02
"""Light that a sensor's own noise is worth."""


@dataclass(frozen=True)
class Isp:
    """Settings relative to the photo's own, in the order in which a camera applies them; the default changes nothing.

    noise       standard deviation of white's linear light; that of darker light goes with its root, as photons' does, down to a floor
    seed        of the noise
    exposure    stops: light times 2^exposure
    red, blue   white balance in stops of the red and blue gain against green
    saturation  factor on the distance to luma; 1 keeps
    sharpen     how much of what a Gaussian of one pixel takes away is added again; 0 keeps
    gamma       exponent on linear light; 1 keeps
    tone        shoulder a > -1 of the curve x (1 + a) / (1 + a x); 0 keeps, above 0 lifts the middle
    """

    exposure: float = 0.0
    red: float = 0.0
    blue: float = 0.0
    saturation: float = 1.0
    gamma: float = 1.0
    tone: float = 0.0
    sharpen: float = 0.0
    noise: float = 0.0
    seed: int = 0

    def __post_init__(self):
        for name in ("exposure", "red", "blue", "saturation", "gamma", "tone", "sharpen", "noise"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}")
        if self.noise < 0 or self.sharpen < 0:
            raise ValueError(f"noise and sharpen must be at least 0, got {self.noise} and {self.sharpen}")
        if self.gamma <= 0 or self.saturation < 0 or self.tone <= -1:
            raise ValueError(
                f"gamma must be above 0, saturation at least 0 and tone above -1, got {self.gamma}, {self.saturation}, {self.tone}"
            )

    def __call__(self, rgb: torch.Tensor) -> torch.Tensor:
        """sRGB `[..., 3, H, W]` in 0..1 through these settings, clipped to 0..1 as a camera clips; each picture has its own noise."""
        x = rgb_to_linear_rgb(rgb.clamp(0, 1))
        if self.noise:
            drawn = torch.randn(x.shape, generator=torch.Generator().manual_seed(self.seed)).to(x)
            x = (x + self.noise * (x + FLOOR).sqrt() * drawn).clamp_min(0)
        gains = torch.tensor(
            [2.0 ** (self.exposure + self.red), 2.0**self.exposure, 2.0 ** (self.exposure + self.blue)], dtype=x.dtype, device=x.device
        )
        # gains, and saturation about the luma that they leave, as one matrix: a GPU waits for samples while colours are made
        grey = torch.tensor(LUMINANCE, dtype=x.dtype, device=x.device).expand(3, 3)
        mixed = (self.saturation * torch.eye(3, dtype=x.dtype, device=x.device) + (1 - self.saturation) * grey) * gains
        x = (mixed @ x.flatten(-2)).view_as(x)
        x = (x + self.sharpen * (x - _blurred(x)) if self.sharpen else x).clamp(0, 1)
        x = x.clamp_min(1e-8) ** self.gamma if self.gamma != 1 else x
        x = x * (1 + self.tone) / (1 + self.tone * x) if self.tone else x
        return linear_rgb_to_rgb(x).clamp(0, 1)


def alter(rgb: torch.Tensor, mask: torch.Tensor, isp: Isp) -> torch.Tensor:
    """`rgb` `[..., 3, H, W]` with `isp` applied where `mask` `[..., 1, H, W]` in 0..1 says; exact where it is 0."""
    return torch.where(mask > 0, rgb + mask * (isp(rgb) - rgb), rgb)


def random_isp(rng: np.random.Generator, strength: float = 1.0) -> Isp:
    """Settings drawn broadly: each control is used three times in five, at least one always."""
    names = ("exposure", "balance", "saturation", "gamma", "tone")
    used = {name for name in names if rng.random() < 0.6} or {names[rng.integers(len(names))]}
    drawn = {
        "exposure": rng.uniform(-1.3, 1.3),
        "red": rng.uniform(-0.5, 0.5),
        "blue": rng.uniform(-0.5, 0.5),
        "saturation": 2.0 ** rng.uniform(-1.2, 0.8),
        "gamma": 2.0 ** rng.uniform(-0.5, 0.5),
        "tone": 2.0 ** rng.uniform(-1.0, 1.5) - 1.0,
    }
    keep = {"exposure": "exposure", "red": "balance", "blue": "balance", "saturation": "saturation", "gamma": "gamma", "tone": "tone"}
    neutral = Isp()
    chosen: dict[str, Any] = {k: _toward(getattr(neutral, k), v, strength) for k, v in drawn.items() if keep[k] in used}
    return Isp(**chosen)


def random_pipeline(rng: np.random.Generator) -> Isp:
    """`random_isp`, and in every other picture more or less sharpening, and noise, than its camera left."""
    isp = random_isp(rng)
    sharpen = float(rng.uniform(0.2, 1.5)) if rng.random() < 0.5 else 0.0
    noise = float(2 ** rng.uniform(-7.0, -4.0)) if rng.random() < 0.5 else 0.0
    return replace(isp, sharpen=sharpen, noise=noise, seed=int(rng.integers(2**31)))


def _blurred(x: torch.Tensor) -> torch.Tensor:
    return gaussian_blur2d(x.reshape(-1, *x.shape[-3:]), (5, 5), (1.0, 1.0)).reshape(x.shape)


def _toward(neutral: float, value: float, strength: float) -> float:
    return float(neutral + strength * (value - neutral))
