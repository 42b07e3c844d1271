"""Lenses by angle: the distance from the image's centre is a function of the angle from the axis."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from scenes.lenses.lens import Lens, first_fall, kept, solve_rising


@dataclass(frozen=True)
class Angular(Lens):
    """A lens that bends by angle alone, so that it may see beyond 90 degrees; depth is the distance from the eye."""

    def radius(self, angle: torch.Tensor) -> torch.Tensor:
        """Distance from the centre at an angle from the axis, before the lens's affine part; rises from 0."""
        raise NotImplementedError

    def radius_slope(self, angle: torch.Tensor) -> torch.Tensor:
        """d radius / d angle."""
        raise NotImplementedError

    def place(self, bent: torch.Tensor) -> torch.Tensor:
        """Pixels `[..., 2]` of radius times direction `[..., 2]`."""
        raise NotImplementedError

    def displaced(self, pixels: torch.Tensor) -> torch.Tensor:
        """The inverse of `place`."""
        raise NotImplementedError

    def project(self, points: torch.Tensor) -> torch.Tensor:
        x, y, z = points.unbind(-1)
        square = x * x + y * y
        on_axis = square <= 1e-24 * z * z
        r = torch.where(on_axis, torch.ones_like(square), square).sqrt()
        # on the axis radius / r goes to slope / z
        scale = torch.where(on_axis, self.radius_slope(torch.zeros_like(z)) / z, self.radius(torch.atan2(r, z)) / r)
        return self.place(points[..., :2] * scale[..., None])

    def unproject(self, pixels: torch.Tensor) -> torch.Tensor:
        bent = self.displaced(pixels)
        square = bent.square().sum(-1)
        on_axis = square <= 1e-24
        radius = torch.where(on_axis, torch.ones_like(square), square).sqrt()
        angle = solve_rising(self.radius, self.radius_slope, radius, self.limit())
        slope = self.radius_slope(torch.zeros_like(radius))
        sine = torch.where(on_axis, 1 / slope, angle.nan_to_num().sin() / radius)
        cosine = torch.where(on_axis, 1.0, angle.nan_to_num().cos())
        lost = angle.isnan() & ~on_axis
        return torch.where(lost[..., None], 0.0, torch.cat([bent * sine[..., None], cosine[..., None]], -1))

    def depth(self, points: torch.Tensor) -> torch.Tensor:
        return points.norm(dim=-1)

    def limit(self) -> float:
        return _fold(self)


@kept
def _fold(lens: Angular) -> float:
    return first_fall(lens.radius_slope, math.pi)
