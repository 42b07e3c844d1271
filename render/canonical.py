"""Splats in the canonical frame where each is the unit Gaussian: what a ray needs to know of them, with gradients."""

from __future__ import annotations

import torch

from render.kernels.canonical import FARTHEST, FRAME, THINNEST
from scenes.gaussians import Gaussians


def canonical_frames(gaussians: Gaussians, cam_from_local: torch.Tensor, group: int = 0) -> torch.Tensor:
    """float64 `[N, FRAME]`: A = S^-1 R' of the camera, row major, the centre p in the camera, A p, and the number of the rays that look at
    them. A and p are differentiable in means, quats, log_scales and the pose float64 `[4, 4]`; A p is theirs, and has no gradient."""
    pose = cam_from_local.to(gaussians.device)
    # splats along the last axis, for all of torch's operations are along it
    means, quats, log_scales = (t.double().t().contiguous() for t in (gaussians.means, gaussians.quats, gaussians.log_scales))
    w, x, y, z = quats / quats.square().sum(0).clamp_min(1e-60).sqrt()
    axes = torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ]
    ).view(3, -1)  # fmt: skip
    a = (pose[:3, :3] @ axes).view(3, 3, -1).transpose(0, 1) * (-log_scales.clamp_min(THINNEST)).exp()[:, None]
    centres = pose[:3, :3] @ means + pose[:3, 3:]
    moved = (a * centres).detach().sum(1)
    if not len(moved[0]) or torch.maximum(a.detach().abs().amax(), moved.abs().amax()) < FARTHEST:
        return torch.cat([a.reshape(9, -1), centres, moved, moved.new_full((1, moved.shape[1]), group)]).t().contiguous()
    met = (moved.abs().amax(0) < FARTHEST) & (a.detach().abs().amax((0, 1)) < FARTHEST)
    nowhere = torch.zeros(FRAME, dtype=torch.float64, device=pose.device)
    nowhere[0], nowhere[10], nowhere[13] = 1.0, FARTHEST, FARTHEST
    out = nowhere.expand(len(met), FRAME).clone()
    kept = met.nonzero()[:, 0]
    return out.index_copy(0, kept, canonical_frames(gaussians.select(kept), cam_from_local, group))
