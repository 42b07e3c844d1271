"""Numbers of each splat that a picture sums up as it does colours: normals, instances, and fields of the caller's own."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from render.projection import at_their_moments
from scenes.camera import Camera
from scenes.checks import check_tensor
from scenes.gaussians import Gaussians, Placed
from scenes.lenses import Orthographic
from scenes.poses import matrix_from_quat

MOST = 128
"""Channels of a caller's field."""

Features = torch.Tensor | Sequence[torch.Tensor]


def channel_fields(
    outputs: Sequence[str], placed: Sequence[Placed], cam_from_local: torch.Tensor, camera: Camera, features: Features | None
) -> dict[str, torch.Tensor]:
    """By output, float32 `[N, C]` over the splats of all instances, whose poses are as of `poses`. ValueError for features that do not
    fit."""
    fields = {}
    if "features" in outputs:
        fields["features"] = _features(placed, features)
    if "normal" in outputs:
        fields["normal"] = torch.cat([normals(p.gaussians, pose, camera) for p, pose in zip(placed, cam_from_local, strict=True)])
    if "instance_alpha" in outputs:
        which = torch.repeat_interleave(torch.arange(len(placed)), torch.tensor([len(p.gaussians) for p in placed]))
        fields["instance_alpha"] = torch.nn.functional.one_hot(which, len(placed)).to(placed[0].gaussians.device, torch.float32)
    return fields


def normals(gaussians: Gaussians, cam_from_local: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Unit vectors `[N, 3]` in the camera along each splat's shortest axis, turned towards where it is seen from, as it is read out."""
    pose = at_their_moments(camera, cam_from_local, gaussians.means).to(torch.float32)
    shortest = gaussians.log_scales.detach().argmin(1)
    axis = matrix_from_quat(gaussians.quats)[torch.arange(len(gaussians), device=gaussians.device), :, shortest]
    normal = (pose[:, :3, :3] @ axis[:, :, None])[..., 0]
    if isinstance(camera.lens, Orthographic):
        away = normal[:, 2] > 0
    else:
        sight = (pose[:, :3, :3] @ gaussians.means[:, :, None])[..., 0] + pose[:, :3, 3]
        away = (normal * sight.detach()).sum(-1) > 0
    return torch.where(away[:, None], -normal, normal)


def unit(sums: torch.Tensor) -> torch.Tensor:
    """`[..., 3]` at length 1; 0 where it is 0, with gradient 0."""
    square = sums.square().sum(-1, keepdim=True)
    some = square > 1e-20
    return torch.where(some, sums / torch.where(some, square, torch.ones_like(square)).sqrt(), torch.zeros_like(sums))


def _features(placed: Sequence[Placed], features: Features | None) -> torch.Tensor:
    if features is None:
        raise ValueError('output "features" needs features=, a tensor [N, C] of the splats or a list with one for each Placed')
    parts = [features] if isinstance(features, torch.Tensor) else list(features)
    sizes = [len(p.gaussians) for p in placed]
    if len(parts) == 1:
        sizes = [sum(sizes)]
    if len(parts) != len(sizes):
        raise ValueError(f"features must be one tensor or one for each of the {len(sizes)} placed, got {len(parts)}")
    for part, size in zip(parts, sizes, strict=True):
        check_tensor("features", part, (size, "C"), torch.float32)
    if not 1 <= parts[0].shape[1] <= MOST or len({part.shape[1] for part in parts}) > 1:
        raise ValueError(f"features must have the same 1 to {MOST} channels for all splats, got {[part.shape[1] for part in parts]}")
    return torch.cat(parts)
