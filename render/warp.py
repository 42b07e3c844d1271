"""Moving what was seen in the previous frame to where it is now, by the renderer's exact flow."""

from __future__ import annotations

import torch
from torch.nn import functional as F


def warp(previous: torch.Tensor, flow_prev: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """`previous` `[B, C, H, W]` brought to this frame, and where that is inside the image `[B, 1, H, W]` (0 or 1).

    flow_prev  `[B, 2, H, W]`, pixels of this grid: position in the previous frame minus position in this one, x right y down;
               where it is not finite nothing is known and the result is 0 and not inside
    """
    b, _, h, w = previous.shape
    known = torch.isfinite(flow_prev).all(1, keepdim=True)
    flow = torch.where(known, flow_prev, 0).float()
    y = torch.arange(h, device=flow.device, dtype=torch.float32)[:, None] + flow[:, 1]
    x = torch.arange(w, device=flow.device, dtype=torch.float32) + flow[:, 0]
    grid = torch.stack([(2 * x + 1) / w - 1, (2 * y + 1) / h - 1], -1)
    inside = known & ((x > -0.5) & (x < w - 0.5) & (y > -0.5) & (y < h - 0.5))[:, None]
    moved = F.grid_sample(previous.float(), grid, mode="bilinear", padding_mode="border", align_corners=False)
    return torch.where(inside, moved, 0).to(previous.dtype), inside.to(previous.dtype)


def visible(flow_prev: torch.Tensor, previous_flow_next: torch.Tensor, tolerance: float = 1.0) -> torch.Tensor:
    """Where this frame's pixel was seen in the previous one, bool `[B, 1, H, W]`: going there and back returns within `tolerance` pixels.

    flow_prev           this frame's flow to the previous one, `[B, 2, H, W]`
    previous_flow_next  the previous frame's flow to this one, `[B, 2, H, W]`
    """
    back, inside = warp(torch.where(torch.isfinite(previous_flow_next), previous_flow_next, 1e6), flow_prev)
    error = (torch.where(torch.isfinite(flow_prev), flow_prev, 1e6) + back).square().sum(1, keepdim=True).sqrt()
    return (inside > 0) & (error < tolerance)
