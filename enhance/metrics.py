"""What the tables measure beside PSNR and SSIM (render/compare.py): features, flicker, sharpness, and how sure a mean is."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch.nn import functional as F

from render.compare import ssim
from render.warp import warp

Features = Callable[[torch.Tensor], Sequence[torch.Tensor]]
"""From a picture `[1, 3, H, W]` to feature maps, coarser and coarser."""

LUMA = torch.tensor([0.299, 0.587, 0.114])
MULTIPLE = 8
RESAMPLED = 2000


def region_ssim(better: torch.Tensor, target: torch.Tensor, region: torch.Tensor) -> float:
    """SSIM of images `[H, W, 3]` within `region`, bool `[H, W]`: 1 less what the region takes from the whole's, per pixel of it."""
    only = torch.where(region[..., None], better, target)
    return 1 - (1 - ssim(only, target)) / float(region.float().mean())


def feature_distance(better: torch.Tensor, target: torch.Tensor, region: torch.Tensor, features: Features) -> float:
    """Squared distance of normalised features of images `[H, W, 3]`, summed over scales, mean over `region` `[H, W]`. It is LPIPS-like
    in form only: what it means depends on whose features these are."""
    pad = (0, -better.shape[1] % MULTIPLE, 0, -better.shape[0] % MULTIPLE)
    a, b = (features(F.pad(x.permute(2, 0, 1)[None], pad, mode="replicate")) for x in (better, target))
    weight = F.pad(region.float()[None, None], pad)
    total = 0.0
    for x, y in zip(a, b, strict=True):
        part = F.adaptive_avg_pool2d(weight, (x.shape[-2], x.shape[-1]))
        each = (F.normalize(x.float(), dim=1) - F.normalize(y.float(), dim=1)).square().sum(1, keepdim=True)
        total += float((each * part).sum() / part.sum().clamp_min(1e-6))
    return total


def sharpness(rgb: torch.Tensor, region: torch.Tensor) -> float:
    """Variance of the Laplacian of luma of `[H, W, 3]` within `region` `[H, W]`: falls where detail is smoothed away. Beyond the picture
    is what is at its border, since black there would be an edge of its own."""
    kernel = torch.tensor([[0.0, 1, 0], [1, -4, 1], [0, 1, 0]])[None, None]
    return float(F.conv2d(F.pad((rgb @ LUMA)[None, None], (1, 1, 1, 1), mode="replicate"), kernel)[0, 0][region].var())


def warp_error(better: torch.Tensor, previous: torch.Tensor, flow: torch.Tensor, visible: torch.Tensor) -> float | None:
    """Mean absolute difference, in 8-bit levels, of an image `[H, W, 3]` to the previous one moved along exact `flow` `[2, H, W]`, on
    `visible` pixels `[1, H, W]`; None where there is none."""
    moved, inside = warp(previous.permute(2, 0, 1)[None], flow[None])
    seen = (visible * inside[0])[0] > 0.5
    if not seen.any():
        return None
    return 255 * float((better - moved[0].permute(1, 2, 0)).abs().mean(-1)[seen].mean())


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Where the mean lies with 95 percent, by drawing the values, one a clip, anew (bootstrap; Efron 1979); NaNs are left out."""
    known = np.array([v for v in values if np.isfinite(v)])
    if len(known) < 2:
        return float("nan"), float("nan")
    means = np.random.default_rng(0).choice(known, (RESAMPLED, len(known))).mean(1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)
