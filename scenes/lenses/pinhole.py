"""The pinhole lens."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from scenes.lenses.lens import Lens, Number


@dataclass(frozen=True)
class Pinhole(Lens):
    """u = fx x/z + cx, v = fy y/z + cy, in pixels."""

    kind: ClassVar[str] = "pinhole"

    fx: Number
    fy: Number
    cx: Number
    cy: Number

    def scaled(self, sx: float, sy: float) -> Pinhole:
        return replace(self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy)

    def project(self, points: torch.Tensor) -> torch.Tensor:
        x, y, z = points.unbind(-1)
        return torch.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], -1)

    def unproject(self, pixels: torch.Tensor) -> torch.Tensor:
        u, v = pixels.unbind(-1)
        return torch.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, torch.ones_like(u)], -1)
