"""The sky: an equirectangular image infinitely far away."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from scenes.checks import check_tensor

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""What linear red, green and blue add to luminance (ITU-R BT.709)."""


def srgb_from_linear(linear: torch.Tensor) -> torch.Tensor:
    """IEC 61966-2-1, values above 1 kept."""
    low = linear.clamp_min(0)
    return torch.where(low <= 0.0031308, 12.92 * low, 1.055 * low.clamp_min(1e-8) ** (1 / 2.4) - 0.055)


def linear_from_srgb(srgb: torch.Tensor) -> torch.Tensor:
    """IEC 61966-2-1 inverse, values above 1 kept."""
    low = srgb.clamp_min(0)
    return torch.where(low <= 0.04045, low / 12.92, ((low + 0.055) / 1.055) ** 2.4)


@dataclass(frozen=True)
class Sky:
    """Equirectangular linear radiance `[H, W, 3]` float32: row 0 looks up (+z), the centre column along world +x, left half along +y."""

    linear: torch.Tensor

    def __post_init__(self):
        check_tensor("linear", self.linear, ("H", "W", 3), torch.float32)
        if min(self.linear.shape[:2]) < 1:
            raise ValueError(f"a sky must be at least 1x1, got {tuple(self.linear.shape[:2])}")

    def colour(self, directions: torch.Tensor) -> torch.Tensor:
        """Display-referred sRGB `[..., 3]` along world directions `[..., 3]` of any length; differentiable in `linear`."""
        return sample_equirect(srgb_from_linear(self.linear), directions)


def texels(height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit world directions `[H, W, 3]` of an equirectangular image's pixels, and the solid angles `[H, W]` that they cover; float64."""
    azimuth = torch.pi * (1 - (2 * torch.arange(width, dtype=torch.float64) + 1) / width)
    edges = torch.pi * (0.5 - torch.arange(height + 1, dtype=torch.float64) / height)
    middle = (edges[:-1] + edges[1:]) / 2
    elevation, around = torch.meshgrid(middle, azimuth, indexing="ij")
    directions = torch.stack([elevation.cos() * around.cos(), elevation.cos() * around.sin(), elevation.sin()], -1)
    ring = (edges[:-1].sin() - edges[1:].sin()) * 2 * torch.pi / width
    return directions, ring[:, None].expand(height, width)


def sample_equirect(image: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Bilinear lookup in an equirectangular image `[H, W, C]`; columns wrap around, rows end at the poles."""
    x, y, z = directions.to(torch.float32).unbind(-1)
    azimuth = torch.atan2(y, x)
    elevation = torch.atan2(z, torch.sqrt(x * x + y * y))
    h, w = image.shape[:2]
    column = (0.5 - azimuth / (2 * torch.pi)) * w - 0.5
    row = ((0.5 - elevation / torch.pi) * h - 0.5).clamp(0, h - 1)
    c0, r0 = column.floor(), row.floor().clamp_max(max(h - 2, 0))
    fc, fr = (column - c0)[..., None], (row - r0)[..., None]
    left, top = c0.long() % w, r0.long()
    right, bottom = (left + 1) % w, (top + 1).clamp_max(h - 1)
    flat = image.reshape(h * w, -1)
    upper = flat[top * w + left] * (1 - fc) + flat[top * w + right] * fc
    lower = flat[bottom * w + left] * (1 - fc) + flat[bottom * w + right] * fc
    return upper * (1 - fr) + lower * fr
