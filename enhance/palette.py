"""From the colours inside a region and around it to the change that makes them one picture.

Harmonization is mostly this: compare two palettes. A small perceptron sees both as soft histograms and moments and gives one
colour change for the whole region; the network adds what depends on place. Working on statistics alone it knows nothing of any
scene, learns in minutes, and carries over to other drives.
"""

from __future__ import annotations

import torch
from torch import nn

BINS = 9
COEFFICIENTS = 12
LUMA = (0.299, 0.587, 0.114)


def palette(rgb: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Statistics `[B, 48]` of the colours `[B, 3, N]` under weights `[B, 1, N]`: soft histograms of the channels and of saturation,
    means and spreads of the channels and of their distance to luma. Zero where the weights are."""
    weight = weight / weight.sum(-1, keepdim=True).clamp_min(1e-4)
    luma = (rgb * rgb.new_tensor(LUMA)[:, None]).sum(1, keepdim=True)
    tint = rgb - luma
    both = torch.cat([rgb, rgb.amax(1, keepdim=True) - rgb.amin(1, keepdim=True)], 1)
    centres = torch.linspace(0, 1, BINS, device=rgb.device, dtype=rgb.dtype)
    near = (1 - (both[..., None] - centres).abs() * (BINS - 1)).clamp_min(0)
    histograms = (near * weight[..., None]).sum(2).flatten(1)
    found = [histograms]
    for x, scale in ((rgb, 1.0), (tint, 5.0)):
        mean = (x * weight).sum(-1)
        variance = ((x - mean[..., None]).square() * weight).sum(-1)
        found += [scale * mean, scale * (variance + 1e-6).sqrt()]
    return torch.cat(found, 1)


class RegionColour(nn.Module):
    """One colour change for a region: `[B, 12]` coefficients as `colour_change` takes them; zero at first."""

    def __init__(self, width: int = 192):
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(2 * (4 * BINS + 12) + 1, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, COEFFICIENTS)
        )
        for parameter in self.mlp[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(self, rgb: torch.Tensor, region: torch.Tensor) -> torch.Tensor:
        """Of `rgb` `[B, 3, H, W]` with the region's weights `[B, 1, H, W]` in 0..1; some thousand pixels are enough."""
        with torch.autocast(rgb.device.type, enabled=False):
            x, w = rgb.float().flatten(2), region.float().flatten(2)
            return self.mlp(torch.cat([palette(x, w), palette(x, 1 - w), w.mean(-1)], 1))
