"""Exact flow on the coarse grids of latents and colour fields."""

from __future__ import annotations

import torch
from torch.nn import functional as F


def shrink_flow(flow: torch.Tensor, size: tuple[int, ...]) -> torch.Tensor:
    """Flow `[B, 2, H, W]` in pixels on a coarser grid of `size` (h, w), in its cells: means of what is known.

    A cell without any known pixel stays unknown (NaN).
    """
    total = flow[:, :1] + flow[:, 1:]
    known = (total - total == 0).float()
    size = (size[0], size[1])
    share = F.adaptive_avg_pool2d(known, size)
    mean = F.adaptive_avg_pool2d(torch.nan_to_num(flow.float(), 0, 0, 0) * known, size) / share
    mean = torch.stack([mean[:, 0] * (size[1] / flow.shape[-1]), mean[:, 1] * (size[0] / flow.shape[-2])], 1)
    return torch.where(share > 0, mean, torch.nan)
