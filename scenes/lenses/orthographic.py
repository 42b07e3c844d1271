"""Parallel rays, as a map has them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from scenes.lenses.lens import Lens, Number


@dataclass(frozen=True)
class Orthographic(Lens):
    """u = fx x + cx, v = fy y + cy; fx, fy in pixels a metre. Rays begin in the plane z = 0 and run along z."""

    kind: ClassVar[str] = "orthographic"

    fx: Number
    fy: Number
    cx: Number
    cy: Number

    def scaled(self, sx: float, sy: float) -> Orthographic:
        return replace(self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy)

    def project(self, points: torch.Tensor) -> torch.Tensor:
        x, y, _ = points.unbind(-1)
        return torch.stack([self.fx * x + self.cx, self.fy * y + self.cy], -1)

    def unproject(self, pixels: torch.Tensor) -> torch.Tensor:
        zero = torch.zeros_like(pixels[..., 0])
        return torch.stack([zero, zero, zero + 1], -1)

    def origins(self, pixels: torch.Tensor) -> torch.Tensor:
        u, v = pixels.unbind(-1)
        return torch.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, torch.zeros_like(u)], -1)

    def limit(self) -> float:
        return math.pi
