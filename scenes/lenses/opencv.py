"""OpenCV's lens: radial, tangential and thin-prism distortion of the plane z = 1."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from scenes.lenses.lens import Lens, Number, first_fall, kept, solve_rising

RING_STEPS = 256
"""Angles at which the determinant is looked at in all directions, before the first where it falls is looked into."""

STEEPEST = 100.0
"""How much further than on the axis a step outward may lead, beside a pole of the radial factor: a splat that reaches all the way to it
would have a footprint of rounding alone. A polynomial is as steep more than ten focal lengths out, beyond any picture."""


@dataclass(frozen=True)
class OpenCV(Lens):
    """Radial k1 to k6 (rational), tangential p1 p2 (Brown 1966), thin prism s1 to s4; fields in OpenCV's order, so that
    `OpenCV(fx, fy, cx, cy, *dist_coeffs)` reads its calibrations of 4, 5, 8 or 12 coefficients.

    With x, y = X/Z, Y/Z and q = x^2 + y^2, the pinhole sees
    x (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3) + 2 p1 x y + p2 (q + 2 x^2) + s1 q + s2 q^2, and
    y (...) + p1 (q + 2 y^2) + 2 p2 x y + s3 q + s4 q^2.
    The domain ends where, in some direction, the Jacobian's determinant first stops being positive, or just before a pole.
    """

    kind: ClassVar[str] = "opencv"

    fx: Number
    fy: Number
    cx: Number
    cy: Number
    k1: Number = 0.0
    k2: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0
    k5: Number = 0.0
    k6: Number = 0.0
    s1: Number = 0.0
    s2: Number = 0.0
    s3: Number = 0.0
    s4: Number = 0.0

    def scaled(self, sx: float, sy: float) -> OpenCV:
        return replace(self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy)

    def project(self, points: torch.Tensor) -> torch.Tensor:
        bent = self._distort(points[..., :2] / points[..., 2:])
        return torch.stack([self.fx * bent[..., 0] + self.cx, self.fy * bent[..., 1] + self.cy], -1)

    def unproject(self, pixels: torch.Tensor) -> torch.Tensor:
        u, v = pixels.unbind(-1)
        seen = torch.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy], -1)
        with torch.no_grad():
            limit = math.tan(min(self.limit(), math.radians(89.9)))
            radius = seen.norm(dim=-1)
            start = solve_rising(lambda r: r * self._radial(r * r)[0], lambda r: self._radial_slope(r), radius, self._radial_limit())
            n = seen * (start.nan_to_num(limit) / radius.clamp_min(1e-300))[..., None]
            for _ in range(8):
                n = n - self._newton(n, seen)
            missed = (self._distort(n) - seen).abs().amax(-1) > 1e-9 * (1 + radius)
            lost = missed | ~(n.norm(dim=-1) < limit)
        n = n - self._newton(n, seen)  # carries the gradients (implicit function theorem)
        return torch.where(lost[..., None], 0.0, torch.cat([n, torch.ones_like(n[..., :1])], -1))

    def limit(self) -> float:
        return _fold(self)

    def _radial(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The radial factor at q and its derivative by q."""
        above = 1 + q * (self.k1 + q * (self.k2 + q * self.k3))
        below = 1 + q * (self.k4 + q * (self.k5 + q * self.k6))
        slope_above = self.k1 + q * (2 * self.k2 + q * 3 * self.k3)
        slope_below = self.k4 + q * (2 * self.k5 + q * 3 * self.k6)
        factor = above / below
        return factor, (slope_above - factor * slope_below) / below

    def _radial_slope(self, r: torch.Tensor) -> torch.Tensor:
        factor, slope = self._radial(r * r)
        return factor + 2 * r * r * slope

    def _radial_limit(self) -> float:
        return math.tan(min(_radial_fold(self), math.radians(89.9)))

    def _distort(self, n: torch.Tensor) -> torch.Tensor:
        x, y = n.unbind(-1)
        q = x * x + y * y
        factor = self._radial(q)[0]
        bent_x = x * factor + 2 * self.p1 * x * y + self.p2 * (q + 2 * x * x) + q * (self.s1 + q * self.s2)
        bent_y = y * factor + self.p1 * (q + 2 * y * y) + 2 * self.p2 * x * y + q * (self.s3 + q * self.s4)
        return torch.stack([bent_x, bent_y], -1)

    def _jacobian(self, n: torch.Tensor) -> torch.Tensor:
        """d distorted / d n, `[..., 2, 2]`."""
        x, y = n.unbind(-1)
        q = x * x + y * y
        factor, slope = self._radial(q)
        prism_x, prism_y = self.s1 + 2 * self.s2 * q, self.s3 + 2 * self.s4 * q
        cross = 2 * x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y
        xx = factor + 2 * x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x + 2 * x * prism_x
        yy = factor + 2 * y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x + 2 * y * prism_y
        return torch.stack([torch.stack([xx, cross + 2 * y * prism_x], -1), torch.stack([cross + 2 * x * prism_y, yy], -1)], -2)

    def _newton(self, n: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            (a, b), (c, d) = (row.unbind(-1) for row in self._jacobian(n).unbind(-2))
            det = (a * d - b * c).clamp_min(1e-9)
        miss = self._distort(n) - seen
        return torch.stack([d * miss[..., 0] - b * miss[..., 1], a * miss[..., 1] - c * miss[..., 0]], -1) / det[..., None]


def _denominator(lens: OpenCV, q: torch.Tensor) -> torch.Tensor:
    return 1 + q * (lens.k4 + q * (lens.k5 + q * lens.k6))


@kept
def _fold(lens: OpenCV) -> float:
    radial = _radial_fold(lens)
    if not any(float(v) for v in (lens.p1, lens.p2, lens.s1, lens.s2, lens.s3, lens.s4)):
        return radial  # alike in all directions: as long as the radius rises, so does all else
    around = torch.linspace(0, 2 * math.pi, 73, dtype=torch.float64)[:-1]
    ring = torch.stack([around.cos(), around.sin()], -1)

    def least(angle: torch.Tensor) -> torch.Tensor:
        (a, b), (c, d) = (row.unbind(-1) for row in lens._jacobian(angle.tan()[:, None, None] * ring).unbind(-2))
        return (a * d - b * c).amin(-1)

    return min(radial, first_fall(least, math.pi / 2, RING_STEPS))


@kept
def _radial_fold(lens: OpenCV) -> float:
    def margin(angle: torch.Tensor) -> torch.Tensor:
        r = angle.tan()
        slope = lens._radial_slope(r)
        return torch.minimum(_denominator(lens, r * r), torch.minimum(slope, STEEPEST - slope))

    return first_fall(margin, math.pi / 2)
