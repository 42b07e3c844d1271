"""Lenses: how a direction in the camera becomes a pixel. A lens is a type; pixels have their centre at +0.5."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch


@dataclass(frozen=True)
class Pinhole:
    """The pinhole lens: u = fx x/z + cx, v = fy y/z + cy, in pixels. Fields are floats or float64 scalar tensors."""

    fx: float | torch.Tensor
    fy: float | torch.Tensor
    cx: float | torch.Tensor
    cy: float | torch.Tensor

    def __post_init__(self):
        for name in ("fx", "fy"):
            value = float(torch.as_tensor(getattr(self, name)).detach())
            if not value > 0:
                raise ValueError(f"{name} must be a positive number of pixels, got {value}")

    def params(self) -> torch.Tensor:
        """float64 `[4]`: fx, fy, cx, cy; differentiable where the fields are tensors."""
        return torch.stack([torch.as_tensor(getattr(self, f.name), dtype=torch.float64) for f in fields(self)])

    def scaled(self, sx: float, sy: float) -> Pinhole:
        """The lens of an image resized by sx, sy."""
        return replace(self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy)

    def project(self, points: torch.Tensor) -> torch.Tensor:
        """Pixels `[..., 2]` of camera points `[..., 3]`; meaningless where z <= 0."""
        x, y, z = points.unbind(-1)
        return torch.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], -1)

    def unproject(self, pixels: torch.Tensor) -> torch.Tensor:
        """Camera directions `[..., 3]` with z = 1 through pixels `[..., 2]`."""
        u, v = pixels.unbind(-1)
        return torch.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, torch.ones_like(u)], -1)
