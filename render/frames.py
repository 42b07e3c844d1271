"""Splats in the canonical frame where each is the unit Gaussian: what a ray needs to know of them."""

from __future__ import annotations

import torch

from render.kernels.types import FRAME
from scenes.gaussians import Gaussians
from scenes.poses import matrix_from_quat

THINNEST = -16.0
"""ln metres: an axis is taken to be no shorter, so that squares of squares stay floats."""

FARTHEST = 1e9
"""In a splat's own scales: one whose centre is further from the eye, or not a number, is met by no ray."""


def canonical_frames(gaussians: Gaussians, cam_from_local: torch.Tensor) -> torch.Tensor:
    """float32 `[N, FRAME]`: M = S^-1 R' of the camera, row major, and q = M p for the centre p in the camera. By autograd
    differentiable in means, quats, log_scales and the pose float64 `[4, 4]`."""
    pose = cam_from_local.to(gaussians.device, torch.float32)
    quats = gaussians.quats / gaussians.quats.norm(dim=1, keepdim=True).clamp_min(1e-30)
    axes = pose[:3, :3] @ matrix_from_quat(quats)
    m = axes.transpose(1, 2) * (-gaussians.log_scales.clamp_min(THINNEST)).exp()[..., None]
    q = (m @ (gaussians.means @ pose[:3, :3].T + pose[:3, 3])[..., None])[..., 0]
    met = (q.detach().norm(dim=1) < FARTHEST) & m.detach().isfinite().all(2).all(1)
    if met.all():
        return torch.cat([m.flatten(1), q], 1)
    nowhere = torch.zeros(FRAME, device=q.device)
    nowhere[0], nowhere[10] = 1.0, FARTHEST
    out = nowhere.expand(len(met), FRAME).clone()
    kept = met.nonzero()[:, 0]
    return out.index_copy(0, kept, canonical_frames(gaussians.select(kept), cam_from_local))
