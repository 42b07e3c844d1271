"""The f-theta lens: any polynomial of the angle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from scenes.lenses.angles import Angular
from scenes.lenses.lens import Number


@dataclass(frozen=True)
class FTheta(Angular):
    """As DriveWorks and NuRec calibrate wide cameras: at angle t from the axis the radius is a1 t + a2 t^2 + ... + a5 t^5 pixels;
    of its parts x, y to the right and down, u = c x + d y + cx, v = e x + y + cy."""

    kind: ClassVar[str] = "ftheta"
    positive: ClassVar[tuple[str, ...]] = ("a1", "c")

    cx: Number
    cy: Number
    a1: Number
    a2: Number = 0.0
    a3: Number = 0.0
    a4: Number = 0.0
    a5: Number = 0.0
    c: Number = 1.0
    d: Number = 0.0
    e: Number = 0.0

    def scaled(self, sx: float, sy: float) -> FTheta:
        grown = {name: getattr(self, name) * sy for name in ("a1", "a2", "a3", "a4", "a5")}
        return replace(self, **grown, cx=self.cx * sx, cy=self.cy * sy, c=self.c * sx / sy, d=self.d * sx / sy)

    def radius(self, angle: torch.Tensor) -> torch.Tensor:
        return angle * (self.a1 + angle * (self.a2 + angle * (self.a3 + angle * (self.a4 + angle * self.a5))))

    def radius_slope(self, angle: torch.Tensor) -> torch.Tensor:
        return self.a1 + angle * (2 * self.a2 + angle * (3 * self.a3 + angle * (4 * self.a4 + angle * 5 * self.a5)))

    def place(self, bent: torch.Tensor) -> torch.Tensor:
        x, y = bent.unbind(-1)
        return torch.stack([self.c * x + self.d * y + self.cx, self.e * x + y + self.cy], -1)

    def displaced(self, pixels: torch.Tensor) -> torch.Tensor:
        u, v = pixels[..., 0] - self.cx, pixels[..., 1] - self.cy
        x = (u - self.d * v) / (self.c - self.d * self.e)
        return torch.stack([x, v - self.e * x], -1)

    def focal(self) -> tuple[float, float]:
        return float(self.a1 * self.c), float(self.a1)
