"""Exact flow on the coarse grids of latents and colour fields."""

from __future__ import annotations

import torch
from torch.nn import functional as F


def shrink_flow(flow: torch.Tensor, size: tuple[int, ...]) -> torch.Tensor:
    """Flow `[B, 2, H, W]` in pixels on a coarser grid of `size` (h, w), in its cells: means of what is known.

    A cell without any known pixel stays unknown (NaN).
    """
    known = torch.isfinite(flow).all(1, keepdim=True)
    size = (size[0], size[1])
    share = F.adaptive_avg_pool2d(known.float(), size)
    mean = F.adaptive_avg_pool2d(torch.where(known, flow, 0).float(), size) / share
    scale = mean.new_tensor([size[1] / flow.shape[-1], size[0] / flow.shape[-2]])[:, None, None]
    return torch.where(share > 0, mean * scale, torch.nan)
