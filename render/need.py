"""Where a picture is badly supported by what was recorded: the places that an enhancer should look at, and the only ones.

A pixel's need, 0 to 1, comes from any of: light that passes between splats which ought to be a wall; splats too large on the image,
since too few stand there; splats drawn out into needles, as optimisation leaves them where it saw too little; a surface that no photo saw
from about here; what was inserted, and the pixels that its shadow darkens.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from render.frame_types import Frame
from render.kept import kept_beside
from render.rays import camera_rays, on_device
from scenes.camera import Camera
from scenes.gaussians import Placed
from scenes.poses import inverse
from scenes.scene import Scene

COARSE = (10.0, 40.0)
"""Sigma in pixels, of a splat's middle axis: from fine to too large."""

STRETCHED = (5.0, 20.0)
"""Longest axis by the middle one: from ordinary to a needle."""

ASIDE = (math.radians(5), math.radians(20))
"""Angle at a surface between the ray from here and that from the nearest photo: from supported to never seen like this."""

NEAREST = 4
"""Photos whose rays are compared; of a lens that sees beyond 90 degrees so many forward, back, and to each side."""

FACING = math.cos(math.radians(60))
"""Photos that look further away than this from where a pixel of a wide lens looks, or the camera, did not see what that sees."""


def support_fields(placed: Sequence[Placed], camera: Camera) -> list[torch.Tensor]:
    """By instance `[N, 2]`: how coarse each splat is on the image, and how stretched, 0 to 1."""
    fields = []
    cam_from_world = inverse(camera.world_from_cam.detach())
    for p in placed:
        pose = (cam_from_world @ p.world_from_local.detach()).to(p.gaussians.device, torch.float32)
        middle, stretched = _shape(p.gaussians.log_scales)
        depth = camera.lens.depth(p.gaussians.means.detach() @ pose[:3, :3].T + pose[:3, 3]).clamp_min(0.1)
        sigma = max(camera.lens.focal()) * middle / depth
        fields.append(torch.stack([_ramp(sigma, COARSE).nan_to_num(1.0), stretched], 1).float())
    return fields


@kept_beside
def _shape(log_scales: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """`[N]` each: the middle axis in metres, and how stretched the splat is, 0 to 1."""
    shortest_first = log_scales.detach().sort(1).values
    stretched = _ramp((shortest_first[:, 2] - shortest_first[:, 1]).exp(), STRETCHED).nan_to_num(1.0)
    return shortest_first[:, 1].exp(), stretched


def need_of(scene: Scene, frame: Frame, shaded: torch.Tensor) -> torch.Tensor:
    """float32 `[H, W]` in 0 to 1. frame: alpha, depth, instance, and features of `support_fields`; shaded: bool `[H, W]`, the pixels that
    an inserted asset's shadow has darkened."""
    assert frame.alpha is not None and frame.depth is not None and frame.instance is not None and frame.features is not None
    alpha = frame.alpha.detach()
    parts = [*frame.features.detach().clamp(0, 1).unbind(-1), alpha * far_from_photos(scene, frame.camera, frame.depth.detach())]
    # with a sky, where all light passes there is sky; where some does, a wall with holes
    parts.append((4 * alpha * (1 - alpha) if scene.sky is not None else 1 - alpha).clamp(0, 1))
    parts.append((torch.isin(frame.instance, torch.tensor(scene.anew(), dtype=torch.int32, device=alpha.device)) | shaded).float())
    return 1 - torch.stack([1 - part for part in parts]).prod(0)


def photos(scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
    """Places `[F, 3]` and directions `[F, 3]`, float64 in the world, of all photos that the scene was made from."""
    first, last = scene.ego.span_us()
    poses = [torch.zeros(0, 4, 4, dtype=torch.float64)]
    for name, rig in scene.rig.items():
        times = scene.frame_times(name)
        poses.append(scene.ego.at_each(times[(times >= first) & (times <= last)]) @ rig.body_from_cam)
    stacked = torch.cat(poses)
    return stacked[:, :3, 3], stacked[:, :3, 2]


def far_from_photos(scene: Scene, camera: Camera, depth: torch.Tensor) -> torch.Tensor:
    """`[H, W]`, 0 to 1: how far the view of each pixel's surface is from that of the nearest photo that looks the same way; 0 for sky."""
    places, directions = photos(scene)
    pose, wide = camera.world_from_cam.detach(), camera.lens.limit() > math.pi / 2
    offsets, looks = (places - pose[:3, 3]) @ pose[:3, :3], directions @ pose[:3, :3]  # in the camera
    order, axes = offsets.norm(dim=1).argsort(), torch.eye(3, dtype=torch.float64)
    ways = [*axes, *-axes] if wide else [axes[2]]
    chosen = torch.cat([order[looks[order] @ way > FACING][:NEAREST] for way in ways]).unique()
    if not len(chosen):
        return torch.isfinite(depth).float()
    rays = on_device(camera_rays(camera), depth.device)
    distance = rays.norm(dim=-1).clamp_min(1e-9)
    unit = rays / distance[..., None]
    distance = distance * depth
    aside = torch.full_like(depth, math.pi)
    for b, look in zip(offsets[chosen].to(depth), looks[chosen].to(depth), strict=True):
        along = unit @ b
        across = (b.square().sum() - along.square()).clamp_min(0).sqrt()
        angle = torch.atan2(across, distance - along)
        aside = torch.minimum(aside, torch.where(unit @ look > FACING, angle, math.pi) if wide else angle)
    return torch.where(torch.isfinite(depth), _ramp(aside, ASIDE), torch.zeros_like(depth))


def _ramp(value: torch.Tensor, span: tuple[float, float]) -> torch.Tensor:
    """0 up to the span's begin, 1 from its end, smooth between."""
    u = ((value - span[0]) / (span[1] - span[0])).clamp(0, 1)
    return u * u * (3 - 2 * u)
