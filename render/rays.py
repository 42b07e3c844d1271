"""Rays through the pixels of a camera: the same for every frame of a clip, so kept. All that follows projection sees of a lens."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch

from render.kept import kept_beside
from render.launch import upload
from scenes.camera import Camera
from scenes.gaussians import Placed
from scenes.lenses import Orthographic
from scenes.poses import interpolate, inverse

HOST = torch.device("cpu")


def camera_rays(camera: Camera) -> torch.Tensor:
    """float32 `[H, W, 3]` directions of depth 1 in the camera through the pixel centres; shared, not to be written to.

    0 0 0 where no direction leads to a pixel: past the edge of a fisheye's image.
    """
    return _rays(camera.lens.key(), camera.width, camera.height)


def camera_origins(camera: Camera) -> torch.Tensor:
    """float32 `[H, W, 3]` or, where all rays begin in the eye, `[3]`: where the rays begin, in the camera."""
    if not isinstance(camera.lens, Orthographic):
        return torch.zeros(3, dtype=torch.float32)
    return camera.lens.origins(camera.pixel_centres()).detach().to(torch.float32)


def world_directions(camera: Camera, device: torch.device = HOST) -> torch.Tensor:
    """float32 `[H, W, 3]` directions in the world through the pixel centres, of any length, each as the camera stood when it saw it."""
    rays, ways = on_device(camera_rays(camera), device), upload(turns(camera).to(torch.float32), device)
    if len(ways) == 1:
        return rays @ ways[0].T
    return torch.einsum("hwj,hij->hwi" if camera.shutter == "rows" else "hwj,wij->hwi", rays, ways)


def turns(camera: Camera) -> torch.Tensor:
    """World from camera, float64 rotations `[1, 3, 3]`, or one for each row or column where the shutter moves."""
    start, end = camera.world_from_cam.detach(), camera.world_from_cam_end
    if camera.shutter == "global" or end is None:
        return start[None, :3, :3]
    return readout(camera, start, end.detach())[:, :3, :3]


def exact_rays(camera: Camera, placed: Sequence[Placed], moving: bool) -> tuple[torch.Tensor, list[int]]:
    """float64 `[G, C, H, W]` rays through the pixel centres, and which of the G look at each of `placed`; differentiable in the lens and,
    where the shutter moves, in all poses.

    C is 3 where all rays begin in the eye, directions of depth 1; else 6, directions and where they begin. Each is in the frame of the
    camera at its start pose: as the pixel sees it when it is read out, and, for an instance that moves by then, as if that stood still.
    """
    if not moving:
        if torch.is_grad_enabled() and camera.lens.params().requires_grad:
            return _exact(camera), [0] * len(placed)
        return _kept_exact(camera.lens.key(), camera.width, camera.height), [0] * len(placed)
    centres = camera.pixel_centres()
    directions, origins = camera.lens.unproject(centres), camera.lens.origins(centres)
    start_from_world = inverse(camera.world_from_cam)
    world_from_cam = readout(camera, camera.world_from_cam, camera.world_from_cam_end)
    groups, ways = [], [start_from_world @ world_from_cam]
    for p in placed:
        groups.append(0 if p.world_from_local_end is None else len(ways))
        if groups[-1]:
            local = readout(camera, p.world_from_local, p.world_from_local_end)
            ways.append(start_from_world @ p.world_from_local @ inverse(local) @ world_from_cam)
    along = "gnij,hnj->gihn" if camera.shutter == "columns" else "gnij,nwj->ginw"
    way = torch.stack(ways)
    shifts = way[..., :3, 3].transpose(1, 2)
    shifts = shifts[:, :, None] if camera.shutter == "columns" else shifts[..., None]
    turned, begun = (torch.einsum(along, way[..., :3, :3], v) for v in (directions, origins))
    return torch.cat([turned, begun + shifts], 1), groups


def on_device(rays: torch.Tensor, device: torch.device) -> torch.Tensor:
    """`rays` there; those that are the same for all frames of a clip are carried over once."""
    return rays.to(device) if rays.device == device or rays.requires_grad else _carried(rays, device)


@kept_beside
def _carried(rays: torch.Tensor, device: torch.device) -> torch.Tensor:
    return rays.to(device)


def readout(camera: Camera, start: torch.Tensor, end: torch.Tensor | None) -> torch.Tensor:
    """A pose `[n, 4, 4]` at the moments at which the rows or columns of the image are read out."""
    steps = camera.width if camera.shutter == "columns" else camera.height
    if end is None:
        return start.expand(steps, 4, 4)
    share = (torch.arange(steps, dtype=torch.float64) + 0.5) / steps
    return interpolate(start.expand(steps, 4, 4), end.expand(steps, 4, 4), share)


def _exact(camera: Camera) -> torch.Tensor:
    centres = camera.pixel_centres()
    parts = [camera.lens.unproject(centres)]
    if isinstance(camera.lens, Orthographic):
        parts.append(camera.lens.origins(centres))
    return torch.cat(parts, -1).permute(2, 0, 1)[None].contiguous()


@lru_cache(maxsize=8)
def _kept_exact(key: tuple, width: int, height: int) -> torch.Tensor:
    lens_type, *numbers = key
    return _exact(Camera(lens_type(*numbers), width, height, torch.eye(4, dtype=torch.float64)))


@lru_cache(maxsize=16)
def _rays(key: tuple, width: int, height: int) -> torch.Tensor:
    lens_type, *numbers = key
    camera = Camera(lens_type(*numbers), width, height, torch.eye(4, dtype=torch.float64))
    return camera.lens.unproject(camera.pixel_centres()).to(torch.float32)
