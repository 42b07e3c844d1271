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


def shrink_flow(flow: torch.Tensor, factor: int) -> torch.Tensor:
    """Flow `[B, 2, H, W]` in pixels to the mean of each block of `factor` pixels, in blocks; unknown pixels do not count.

    A block without any known pixel stays unknown (NaN).
    """
    known = torch.isfinite(flow).all(1, keepdim=True)
    count = F.avg_pool2d(known.float(), factor)
    mean = F.avg_pool2d(torch.where(known, flow, 0).float(), factor) / count
    return torch.where(count > 0, mean / factor, torch.nan)


def visible(flow_prev: torch.Tensor, previous_flow_next: torch.Tensor, tolerance: float = 1.0) -> torch.Tensor:
    """Where this frame's pixel was seen in the previous one, bool `[B, 1, H, W]`: going there and back returns within `tolerance` pixels.

    flow_prev           this frame's flow to the previous one, `[B, 2, H, W]`
    previous_flow_next  the previous frame's flow to this one, `[B, 2, H, W]`
    """
    back, inside = warp(torch.where(torch.isfinite(previous_flow_next), previous_flow_next, 1e6), flow_prev)
    error = (torch.where(torch.isfinite(flow_prev), flow_prev, 1e6) + back).square().sum(1, keepdim=True).sqrt()
    return (inside > 0) & (error < tolerance)


def carry(latents: torch.Tensor, valid: torch.Tensor, flow_prev: torch.Tensor | None, stride: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A history `[B, K, C, h, w]` with its validity `[B, K, 1, h, w]` moved to the next frame by its flow `[B, 2, h stride, w stride]`.

    Without flow the history stays where it is.
    """
    if flow_prev is None or latents.shape[1] == 0:
        return latents, valid
    b, k = latents.shape[:2]
    flow = shrink_flow(flow_prev, stride).repeat_interleave(k, 0)
    moved, inside = warp(torch.cat([latents.flatten(0, 1), valid.flatten(0, 1)], 1), flow)
    latents, valid = moved[:, :-1].unflatten(0, (b, k)), ((moved[:, -1:] > 0.5) * inside).unflatten(0, (b, k))
    return latents, valid
