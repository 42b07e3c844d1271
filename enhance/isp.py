"""What a camera's image pipeline can do to colour, in linear light: the damage that harmonization undoes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

LUMA = (0.2126, 0.7152, 0.0722)


@dataclass(frozen=True)
class Isp:
    """Colour settings relative to the photo's own; the default changes nothing.

    exposure    stops: light times 2^exposure
    red, blue   white balance in stops of the red and blue gain against green
    saturation  factor on the distance to luma; 1 keeps
    gamma       exponent on linear light; 1 keeps
    tone        shoulder a > -1 of the curve x (1 + a) / (1 + a x); 0 keeps, above 0 lifts the middle
    """

    exposure: float = 0.0
    red: float = 0.0
    blue: float = 0.0
    saturation: float = 1.0
    gamma: float = 1.0
    tone: float = 0.0

    def __post_init__(self):
        for name in ("exposure", "red", "blue", "saturation", "gamma", "tone"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}")
        if self.gamma <= 0 or self.saturation < 0 or self.tone <= -1:
            raise ValueError(
                f"gamma must be above 0, saturation at least 0 and tone above -1, got {self.gamma}, {self.saturation}, {self.tone}"
            )

    def __call__(self, rgb: torch.Tensor) -> torch.Tensor:
        """sRGB `[..., 3, H, W]` in 0..1 through these settings, clipped to 0..1 as a camera clips."""
        from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

        x = rgb_to_linear_rgb(rgb.clamp(0, 1))
        gains = torch.tensor(
            [2.0 ** (self.exposure + self.red), 2.0**self.exposure, 2.0 ** (self.exposure + self.blue)], dtype=x.dtype, device=x.device
        )
        x = x * gains[:, None, None]
        luma = (x * torch.tensor(LUMA, dtype=x.dtype, device=x.device)[:, None, None]).sum(-3, keepdim=True)
        x = (luma + self.saturation * (x - luma)).clamp(0, 1)
        x = x.clamp_min(1e-8) ** self.gamma if self.gamma != 1 else x
        x = x * (1 + self.tone) / (1 + self.tone * x)
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
    return Isp(**{k: _toward(getattr(neutral, k), v, strength) for k, v in drawn.items() if keep[k] in used})


def _toward(neutral: float, value: float, strength: float) -> float:
    return float(neutral + strength * (value - neutral))
