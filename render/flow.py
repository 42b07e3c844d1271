"""Optical flow from depth: where the surface seen by a pixel stands in the other frame."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from render.rays import camera_origins, camera_rays
from scenes.camera import Camera
from scenes.gaussians import Placed
from scenes.poses import inverse


def image_flow(
    placed: Sequence[Placed], camera: Camera, depth: torch.Tensor, instance: torch.Tensor, there: Sequence[Placed], other: Camera
) -> torch.Tensor:
    """Flow `[H, W, 2]` in pixels: position in `other` minus position here, of each pixel's surface point.

    The point lies at the pixel's depth and moves rigidly with its instance. Where nothing is drawn (instance -1) the pixel is
    sky and moves by the cameras' rotation only. Points that the other lens does not see have flow nan.
    """
    device = depth.device
    other_from_world = inverse(other.world_from_cam)
    moved = {p.instance: p.world_from_local for p in there}
    rays = camera_rays(camera).to(device)
    sky = depth.isinf() | (instance < 0)
    points = camera_origins(camera).to(device) + rays * torch.where(sky, torch.ones_like(depth), depth)[..., None]
    turn = (other_from_world @ camera.world_from_cam)[:3, :3].to(device, torch.float32)
    out = points @ turn.T
    seen = set(instance.unique().tolist())
    for p in placed:
        if p.instance not in seen:
            continue
        end = moved.get(p.instance, p.world_from_local)
        motion = (other_from_world @ end @ inverse(p.world_from_local) @ camera.world_from_cam).to(device, torch.float32)
        mine = (instance == p.instance) & ~sky
        out[mine] = points[mine] @ motion[:3, :3].T + motion[:3, 3]
    flow = other.lens.project(out) - camera.lens.project(points)
    return torch.where(other.lens.valid(out)[..., None], flow, torch.nan).to(torch.float32)
