"""Directions through the pixels of a camera: the same for every frame of a clip, so kept."""

from __future__ import annotations

from functools import lru_cache

import torch

from scenes.camera import Camera


def camera_rays(camera: Camera) -> torch.Tensor:
    """float32 `[H, W, 3]` directions in the camera, z = 1, through the pixel centres; shared, not to be written to."""
    params = tuple(camera.lens.params().tolist())
    return _rays(type(camera.lens), params, camera.width, camera.height)  # type: ignore[arg-type]  # mypy hashes the instance


def world_directions(camera: Camera) -> torch.Tensor:
    """float32 `[H, W, 3]` directions in the world through the pixel centres, of any length."""
    return camera_rays(camera) @ camera.world_from_cam[:3, :3].detach().to(torch.float32).T


@lru_cache(maxsize=16)
def _rays(lens_type: type, params: tuple[float, ...], width: int, height: int) -> torch.Tensor:
    camera = Camera(lens_type(*params), width, height, torch.eye(4, dtype=torch.float64))
    return camera.lens.unproject(camera.pixel_centres()).to(torch.float32)
