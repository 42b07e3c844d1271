"""Optical flow from depth: where the surface seen by a pixel stands in the other frame, and whether that frame sees it too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch.nn import functional as F

from render.rays import camera_origins, camera_rays
from scenes.camera import Camera
from scenes.gaussians import Placed
from scenes.poses import inverse

HIDES = 0.05
"""What lies nearer by this share of the depth hides a point; less is the roughness of splatted surfaces."""


@dataclass(frozen=True)
class Correspondence:
    """Each pixel's surface point in the other frame: points `[H, W, 3]` in that camera, flow `[H, W, 2]` in pixels, nan where the other
    lens does not see, pixels `[H, W, 2]` there."""

    other: Camera
    points: torch.Tensor
    flow: torch.Tensor
    pixels: torch.Tensor

    def visible(self, depth: torch.Tensor) -> torch.Tensor:
        """bool `[H, W]`: the point falls into the other image, and there `depth` `[H', W']` shows nothing nearer in all four pixels
        around it. Sky hides nothing and is hidden by all."""
        height, width = depth.shape
        corner = torch.floor(torch.nan_to_num(self.pixels, nan=-9.0).clamp(-9, 1e6) + 0.5).long()
        around = F.max_pool2d(F.pad(depth[None, None], (1, 1, 1, 1), value=-torch.inf), 2, 1)[0, 0]  # of the pixels that meet in a corner
        farthest = around[corner[..., 1].clamp(0, height), corner[..., 0].clamp(0, width)]
        size = torch.tensor([width, height], device=depth.device)
        inside = ((self.pixels >= 0) & (self.pixels <= size)).all(-1)
        return inside & (farthest >= (1 - HIDES) * self.other.lens.depth(self.points))


def correspond(
    placed: Sequence[Placed], camera: Camera, depth: torch.Tensor, instance: torch.Tensor, there: Sequence[Placed], other: Camera,
    corner: tuple[int, int] = (0, 0),
) -> Correspondence:  # fmt: skip
    """Where the surface points of `depth` and `instance` `[h, w]` stand in `other`. corner: x, y of the first pixel in `camera`'s image.

    A point lies at the pixel's depth and moves rigidly with its instance. Where nothing is drawn (instance -1) the pixel is
    sky and moves by the cameras' rotation only: its point is infinitely far.
    """
    device = depth.device
    height, width = depth.shape
    part = (slice(corner[1], corner[1] + height), slice(corner[0], corner[0] + width))
    other_from_world = inverse(other.world_from_cam)
    moved = {p.instance: p.world_from_local for p in there}
    origins = camera_origins(camera)
    sky = depth.isinf() | (instance < 0)
    rays = camera_rays(camera)[part].to(device) * torch.where(sky, torch.ones_like(depth), depth)[..., None]
    points = (origins[part] if origins.ndim == 3 else origins).to(device) + rays
    turn = (other_from_world @ camera.world_from_cam)[:3, :3].to(device, torch.float32)
    out = points @ turn.T
    seen = set(instance.unique().tolist())
    for p in placed:
        if p.instance not in seen:
            continue
        end = moved.get(p.instance, p.world_from_local)
        mine = (instance == p.instance) & ~sky
        if torch.equal(end, p.world_from_local):  # what stands is most of the picture, and need not be taken out of it
            out += mine[..., None] * (other_from_world @ camera.world_from_cam)[:3, 3].to(device, torch.float32)
            continue
        motion = (other_from_world @ end @ inverse(p.world_from_local) @ camera.world_from_cam).to(device, torch.float32)
        out[mine] = points[mine] @ motion[:3, :3].T + motion[:3, 3]
    pixels = other.lens.project(out)
    flow = torch.where(other.lens.valid(out)[..., None], pixels - camera.lens.project(points), torch.nan).to(torch.float32)
    pixels = torch.where(flow.isnan(), torch.nan, pixels)
    return Correspondence(other, torch.where(sky[..., None], out * torch.inf, out), flow, pixels)
