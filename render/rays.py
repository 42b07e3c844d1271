"""Rays through the pixels of a camera: the same for every frame of a clip, so kept. All that follows projection sees of a lens."""

from __future__ import annotations

from functools import lru_cache

import torch

from scenes.camera import Camera
from scenes.lenses import Orthographic
from scenes.poses import interpolate


def camera_rays(camera: Camera) -> torch.Tensor:
    """float32 `[H, W, 3]` directions of depth 1 in the camera through the pixel centres; shared, not to be written to.

    0 0 0 where no direction leads to a pixel: past the edge of a fisheye's image.
    """
    return _rays(camera.lens.key(), camera.width, camera.height)


def camera_origins(camera: Camera) -> torch.Tensor:
    """float32 `[H, W, 3]` or, where all rays begin in the eye, `[3]`: where the rays begin, in the camera."""
    if not isinstance(camera.lens, Orthographic):
        return torch.zeros(3)
    return camera.lens.origins(camera.pixel_centres()).detach().to(torch.float32)


def world_directions(camera: Camera) -> torch.Tensor:
    """float32 `[H, W, 3]` directions in the world through the pixel centres, of any length, each as the camera stood when it saw it."""
    rays, start, end = camera_rays(camera), camera.world_from_cam.detach(), camera.world_from_cam_end
    if camera.shutter == "global" or end is None:
        return rays @ start[:3, :3].to(torch.float32).T
    steps = camera.height if camera.shutter == "rows" else camera.width
    share = (torch.arange(steps, dtype=torch.float64) + 0.5) / steps
    turns = interpolate(start.expand(steps, 4, 4), end.detach().expand(steps, 4, 4), share)[:, :3, :3].to(torch.float32)
    return torch.einsum("hwj,hij->hwi" if camera.shutter == "rows" else "hwj,wij->hwi", rays, turns)


@lru_cache(maxsize=16)
def _rays(key: tuple, width: int, height: int) -> torch.Tensor:
    lens_type, *numbers = key
    camera = Camera(lens_type(*numbers), width, height, torch.eye(4, dtype=torch.float64))
    return camera.lens.unproject(camera.pixel_centres()).to(torch.float32)
