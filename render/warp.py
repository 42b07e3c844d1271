"""Moving what was seen in the previous frame to where it is now, by the renderer's exact flow."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch.nn import functional as F


def warp(previous: torch.Tensor, flow_prev: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """`previous` `[B, C, H, W]` brought to this frame, and where that is inside the image `[B, 1, H, W]` (0 or 1).

    flow_prev  `[B, 2, H, W]`, pixels of this grid: position in the previous frame minus position in this one, x right y down;
               where it is not finite nothing is known and the result is 0 and not inside
    """
    h, w = previous.shape[-2:]
    total = flow_prev[:, :1] + flow_prev[:, 1:]
    known = total - total == 0
    flow = torch.nan_to_num(flow_prev, 0, 0, 0).permute(0, 2, 3, 1).float()
    grid = torch.addcmul(_centres(h, w, flow.device), flow, _steps(h, w, flow.device))
    x, y = grid[:, None].unbind(-1)
    inside = known & (torch.maximum(x.abs(), y.abs()) < 1)
    moved = F.grid_sample(previous.float(), grid, mode="bilinear", padding_mode="border", align_corners=False)
    inside = inside.to(moved.dtype)
    return (moved * inside).to(previous.dtype), inside.to(previous.dtype)


@lru_cache(maxsize=8)
def _centres(height: int, width: int, device: torch.device) -> torch.Tensor:
    """Pixel centres `[H, W, 2]`, x and y from -1 to 1 across the image; shared, not to be written to."""
    y, x = ((2 * torch.arange(n, device=device, dtype=torch.float32) + 1) / n - 1 for n in (height, width))
    return torch.stack([x.expand(height, width), y[:, None].expand(height, width)], -1)


@lru_cache(maxsize=8)
def _steps(height: int, width: int, device: torch.device) -> torch.Tensor:
    """One pixel along x and y in the same measure; kept, because to copy two numbers to a GPU is to wait for it."""
    return torch.tensor([2 / width, 2 / height], dtype=torch.float32, device=device)


def visible(flow_prev: torch.Tensor, previous_flow_next: torch.Tensor) -> torch.Tensor:
    """Where this frame's pixel was seen in the previous one, bool `[B, 1, H, W]`: going there and back returns within a pixel.

    flow_prev           this frame's flow to the previous one, `[B, 2, H, W]`
    previous_flow_next  the previous frame's flow to this one, `[B, 2, H, W]`
    """
    back, inside = warp(torch.where(torch.isfinite(previous_flow_next), previous_flow_next, 1e6), flow_prev)
    error = (torch.where(torch.isfinite(flow_prev), flow_prev, 1e6) + back).square().sum(1, keepdim=True).sqrt()
    return (inside > 0) & (error < 1.0)
