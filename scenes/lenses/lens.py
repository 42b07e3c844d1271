"""What every lens can do, and the one-dimensional solving that several share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar, Self, TypeVar

import torch

Number = float | torch.Tensor
_STEPS = 4096


@dataclass(frozen=True)
class Lens:
    """How a point in the camera (x right, y down, z forward) becomes a pixel, whose centre is at +0.5, and back.

    A lens is a type; its fields are floats or float64 scalar tensors, and everything is differentiable in them but the edge of the
    valid domain. The domain is a cone about the axis, of half angle `limit()`: past the distortion's fold-over, where further
    directions come back over the image, nothing is drawn.
    """

    kind: ClassVar[str]
    """The lens's name in files."""
    positive: ClassVar[tuple[str, ...]] = ("fx", "fy")
    """Fields that must be positive."""

    if TYPE_CHECKING:  # every lens has them, each in its own place
        cx: Number
        cy: Number

    def __post_init__(self):
        for name in (f.name for f in fields(self)):
            value = float(getattr(self, name))
            if name in self.positive and not value > 0:
                raise ValueError(f"{name} must be a positive number of pixels, got {value}")
            if not math.isfinite(value):
                raise ValueError(f"{name} of a lens must be finite, got {value}")

    def params(self) -> torch.Tensor:
        """float64 `[P]`: the fields in order; differentiable where they are tensors."""
        numbers = [getattr(self, f.name) for f in fields(self)]
        if any(isinstance(number, torch.Tensor) for number in numbers):
            return torch.stack([torch.as_tensor(number, dtype=torch.float64) for number in numbers])
        return torch.tensor(numbers, dtype=torch.float64)

    def scaled(self, sx: float, sy: float) -> Self:
        """The lens of an image resized by sx, sy."""
        raise NotImplementedError

    def project(self, points: torch.Tensor) -> torch.Tensor:
        """Pixels `[..., 2]` of camera points `[..., 3]`; meaningless where not `valid`."""
        raise NotImplementedError

    def unproject(self, pixels: torch.Tensor) -> torch.Tensor:
        """Camera directions `[..., 3]` of depth 1 through pixels `[..., 2]`; 0 0 0 where no direction leads to the pixel.

        A surface at `depth` stands at `origins(pixels) + depth * unproject(pixels)`.
        """
        raise NotImplementedError

    def origins(self, pixels: torch.Tensor) -> torch.Tensor:
        """Where the rays through pixels `[..., 2]` begin, `[..., 3]`: the eye, for all lenses but the orthographic."""
        return pixels.new_zeros(*pixels.shape[:-1], 3)

    def depth(self, points: torch.Tensor) -> torch.Tensor:
        """What depth means for this lens, metres `[...]` of points `[..., 3]`: z; the distance where the lens sees beyond 90 degrees."""
        return points[..., 2]

    def limit(self) -> float:
        """Half angle of the valid domain about the axis, radians; pi where every direction is valid."""
        return math.pi / 2

    def valid(self, points: torch.Tensor) -> torch.Tensor:
        """Mask `[...]` of camera points `[..., 3]` inside the domain."""
        return points[..., 2] > math.cos(self.limit()) * points.norm(dim=-1)

    def focal(self) -> tuple[float, float]:
        """Pixels a radian to the right and down at the middle of the view: fx, fy."""
        return float(self.fx), float(self.fy)  # type: ignore[attr-defined]

    def key(self) -> tuple:
        """Type and numbers, hashable: what may be kept for a lens is kept under it."""
        return type(self), *self.params().tolist()


def first_fall(margin: Callable[[torch.Tensor], torch.Tensor], end: float, steps: int = _STEPS) -> float:
    """The largest x up to `end` such that margin `[n] -> [n]` is positive on all of (0, x), by a look at all steps and then bisection."""
    x = torch.linspace(0, end, steps + 1, dtype=torch.float64)[1:-1]
    bad = ~(margin(x) > 0)
    if not bad.any():
        return end
    high = float(x[int(bad.nonzero()[0])])
    low = high - end / steps
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if bool((margin(torch.tensor([middle], dtype=torch.float64)) > 0).all()) else (low, middle)
    return low


def solve_rising(
    f: Callable[[torch.Tensor], torch.Tensor], slope: Callable[[torch.Tensor], torch.Tensor], values: torch.Tensor, end: float
) -> torch.Tensor:
    """x in [0, end] with f(x) = values `[...]`, f rising from f(0) = 0; nan above f(end). Differentiable in `values` and in f's parameters.

    A table leads Newton's iteration; its last step carries the gradients (implicit function theorem).
    """
    with torch.no_grad():
        table_x = torch.linspace(0, end, _STEPS + 1, dtype=torch.float64)
        table_f = f(table_x).cummax(0).values
        right = torch.searchsorted(table_f, values.detach().contiguous()).clamp(1, _STEPS)
        f0, f1 = table_f[right - 1], table_f[right]
        x = (right - 1 + ((values - f0) / (f1 - f0).clamp_min(1e-300)).clamp(0, 1)) * (end / _STEPS)
        for _ in range(6):  # beside a fold the slope goes to 0: there the table's cell holds the step back
            step = (f(x) - values) / slope(x).clamp_min(1e-12)
            x = torch.minimum(torch.maximum(x - step, (right - 1) * (end / _STEPS)), right * (end / _STEPS))
        beyond = values > table_f[-1] * (1 + 1e-12)
        steep = slope(x).clamp_min(1e-9)
    x = x - (f(x) - values) / steep
    return torch.where(beyond, torch.nan, x)


_L = TypeVar("_L", bound=Lens)


def kept(compute: Callable[[_L], float]) -> Callable[[_L], float]:
    """Keep what `compute` finds for a lens, under its numbers: asked for at every frame, it changes with the lens only."""
    found = lru_cache(maxsize=64)(lambda key: compute(key[0](*key[1:])))

    def look(lens: _L) -> float:
        return found(lens.key())

    return look
