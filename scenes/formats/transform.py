"""Splats under the transform of a file's node: turned, moved, scaled, stretched and mirrored, as Gaussians and their harmonics follow."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from scenes.gaussians import Gaussians
from scenes.harmonics import turned
from scenes.poses import matrix_from_quat, quat_from_matrix, quat_product

_PART = 1 << 18

Z_FROM_Y_UP = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
"""Turns what is y up, as glTF and SPZ have it, to this project's z up."""


def moved(gaussians: Gaussians, pose: torch.Tensor, path: Path) -> Gaussians:
    """Splats under a float64 `[4, 4]`; the same object where it does nothing. ValueError where it makes them flat, or is not finite."""
    if (pose - torch.eye(4)).abs().max() < 1e-7:
        return gaussians
    linear = pose[:3, :3]
    if not (torch.isfinite(pose).all() and (stretch := torch.linalg.svdvals(linear)).min() > 1e-9 * stretch.max()):
        raise ValueError(f"{path} has splats under a node whose scale is 0 or not finite along an axis: {linear.tolist()}")
    means = (gaussians.means.double() @ linear.T + pose[:3, 3]).float()
    scale = torch.linalg.det(linear).clamp_min(0) ** (1 / 3)
    if (linear @ linear.T - scale**2 * torch.eye(3)).abs().max() < 1e-5 * scale**2:
        turn = linear / scale
        quats, log_scales = quat_product(quat_from_matrix(turn).float(), gaussians.quats), gaussians.log_scales + scale.log().float()
    else:
        u, _, vh = torch.linalg.svd(linear)
        turn = u @ vh  # the nearest rotation or mirror; harmonics cannot stretch
        parts = [_stretched(q, s, linear) for q, s in zip(gaussians.quats.split(_PART), gaussians.log_scales.split(_PART), strict=True)]
        quats, log_scales = (torch.cat(column) for column in zip(*parts, strict=True))
    return replace(gaussians, means=means, quats=quats, log_scales=log_scales, sh=turned(gaussians.sh, turn))


def _stretched(quats: torch.Tensor, log_scales: torch.Tensor, linear: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Quaternions and log scales of Gaussians whose axes any `[3, 3]` maps: its product with them has the new ones as singular vectors."""
    quats = quats.double() / quats.double().norm(dim=1, keepdim=True)
    largest = log_scales.double().amax(1, keepdim=True)
    axes = linear @ matrix_from_quat(quats) * (log_scales - largest).exp()[:, None]
    bad = ~torch.isfinite(axes).flatten(1).all(1)  # `validate` names these; singular values of nan would end it all
    turns, scales, _ = torch.linalg.svd(torch.where(bad[:, None, None], torch.eye(3, dtype=axes.dtype), axes))
    turns = turns * torch.where(torch.linalg.det(turns) < 0, -1.0, 1.0)[:, None, None]
    log_scales = torch.where(bad[:, None], torch.nan, scales.clamp_min(1e-30).log() + largest)
    return quat_from_matrix(turns).float(), log_scales.float()
