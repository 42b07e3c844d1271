"""The fisheye lens of Kannala and Brandt."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from scenes.lenses.angles import Angular
from scenes.lenses.lens import Number


@dataclass(frozen=True)
class Fisheye(Angular):
    """Kannala and Brandt (2006) as OpenCV's fisheye module has it: at angle t from the axis the radius is
    t + k1 t^3 + k2 t^5 + k3 t^7 + k4 t^9, times fx and fy. Sees to the fold-over, 180 degrees from the axis where there is none."""

    kind: ClassVar[str] = "fisheye"

    fx: Number
    fy: Number
    cx: Number
    cy: Number
    k1: Number = 0.0
    k2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0

    def scaled(self, sx: float, sy: float) -> Fisheye:
        return replace(self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy)

    def radius(self, angle: torch.Tensor) -> torch.Tensor:
        q = angle * angle
        return angle * (1 + q * (self.k1 + q * (self.k2 + q * (self.k3 + q * self.k4))))

    def radius_slope(self, angle: torch.Tensor) -> torch.Tensor:
        q = angle * angle
        return 1 + q * (3 * self.k1 + q * (5 * self.k2 + q * (7 * self.k3 + q * 9 * self.k4)))

    def place(self, bent: torch.Tensor) -> torch.Tensor:
        return torch.stack([self.fx * bent[..., 0] + self.cx, self.fy * bent[..., 1] + self.cy], -1)

    def displaced(self, pixels: torch.Tensor) -> torch.Tensor:
        return torch.stack([(pixels[..., 0] - self.cx) / self.fx, (pixels[..., 1] - self.cy) / self.fy], -1)
