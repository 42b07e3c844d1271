"""A camera that looks at something, and the corners of what it looks at."""

from __future__ import annotations

import torch

from scenes.camera import Camera
from scenes.lenses import Pinhole


def looking_at(target: torch.Tensor, eye: torch.Tensor, width: int, height: int) -> Camera:
    """A camera at `eye` that looks at `target` with the world's z up in the picture."""
    forward = (target - eye) / (target - eye).norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    right = right / right.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], 1)
    pose[:3, 3] = eye
    return Camera(Pinhole(1.75 * width, 1.75 * width, width / 2, height / 2), width, height, pose)


def corners_of(size: torch.Tensor) -> torch.Tensor:
    """The corners `[8, 3]` of a box `[3]` that stands on its base centre."""
    signs = torch.tensor([[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (0.0, 1.0)], dtype=torch.float64)
    return signs * size
