"""The whole sphere as longitude and latitude."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from scenes.lenses.lens import Lens, Number


@dataclass(frozen=True)
class Equirectangular(Lens):
    """u = fx longitude + cx, v = fy latitude + cy, pixels a radian; longitude atan2(x, z), latitude down from the horizon.

    Its left and right edges meet at longitude +-180 degrees: what lies there is drawn on both. Depth is the distance from the eye.
    """

    kind: ClassVar[str] = "equirectangular"

    fx: Number
    fy: Number
    cx: Number
    cy: Number

    @classmethod
    def whole(cls, width: int, height: int) -> Equirectangular:
        """The lens of an image of the whole sphere, +z in its middle."""
        return cls(width / (2 * math.pi), height / math.pi, width / 2, height / 2)

    def scaled(self, sx: float, sy: float) -> Equirectangular:
        return replace(self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy)

    def project(self, points: torch.Tensor) -> torch.Tensor:
        x, y, z = points.unbind(-1)
        longitude, latitude = torch.atan2(x, z), torch.atan2(y, (x * x + z * z).sqrt())
        return torch.stack([self.fx * longitude + self.cx, self.fy * latitude + self.cy], -1)

    def unproject(self, pixels: torch.Tensor) -> torch.Tensor:
        longitude, latitude = (pixels[..., 0] - self.cx) / self.fx, (pixels[..., 1] - self.cy) / self.fy
        flat = latitude.cos()
        rays = torch.stack([flat * longitude.sin(), latitude.sin(), flat * longitude.cos()], -1)
        return torch.where((latitude.abs() > math.pi / 2)[..., None], 0.0, rays)

    def depth(self, points: torch.Tensor) -> torch.Tensor:
        return points.norm(dim=-1)

    def limit(self) -> float:
        return math.pi

    def period(self) -> torch.Tensor:
        """Pixels of a whole turn."""
        return 2 * math.pi * torch.as_tensor(self.fx, dtype=torch.float64)
