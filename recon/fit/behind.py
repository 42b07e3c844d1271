"""What lies behind a picture, by direction: a kernel each, where the plain functions of `scenes/sky.py` and `recon/views/skies.py` are some
twenty operations."""

from __future__ import annotations

import torch
import warp as wp

from recon.kernels.behind import find_corners, look_up
from render.launch import run, stage, view


def sampled(picture: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """As `sample_equirect`: colours `[..., C]` of a picture `[H, 2H, C]` along float32 directions `[..., 3]`; differentiable in it."""
    flat, device = directions.reshape(-1, 3).contiguous(), directions.device
    places = torch.empty(len(flat), 4, dtype=torch.int64, device=device)
    shares = torch.empty(len(flat), 4, device=device)
    with stage(device):
        args = [view(flat, wp.vec3), len(picture), view(places, wp.int64), view(shares, float)]
        run(find_corners, len(flat), args, device)
    return (picture.flatten(0, 1)[places] * shares[..., None]).sum(1).view(*directions.shape[:-1], -1)


def masked(mask: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """What a mask bool `[R, 2R]` says of float32 directions `[..., 3]`: bool `[...]`."""
    flat, device = directions.reshape(-1, 3).contiguous(), directions.device
    out = torch.empty(len(flat), dtype=torch.bool, device=device)
    with stage(device):
        args = [view(flat, wp.vec3), view(mask.view(torch.uint8), wp.uint8), view(out.view(torch.uint8), wp.uint8)]
        run(look_up, len(flat), args, device)
    return out.view(directions.shape[:-1])
