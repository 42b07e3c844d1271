"""Colours of a picture by mean and covariance, and the linear map that moves them least to those of another: the transport of Monge and
Kantorovich between two Gaussians (Pitié and Kokaram 2007), A^-1/2 (A^1/2 B A^1/2)^1/2 A^-1/2 from covariance A to B."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from enhance.averaged import Averaged

FLAT = 1e-4
"""Variance that every picture is taken to have in all directions, so that a grey one has a map."""

STRETCH = 4.0
"""Times that a map makes differences of colours larger or smaller, at most: beyond, it is noise that grows."""


@dataclass(frozen=True)
class Colours(Averaged):
    """Mean `[3]` and covariance `[3, 3]` of a picture's colours, float64."""

    mean: torch.Tensor
    spread: torch.Tensor

    @classmethod
    def of(cls, rgb: torch.Tensor) -> Colours:
        """Of pixels `[N, 3]`."""
        rgb = rgb.double().cpu()
        mean = rgb.mean(0)
        return cls(mean, (rgb - mean).T @ (rgb - mean) / max(len(rgb), 1))


@dataclass(frozen=True)
class Map(Averaged):
    """rgb -> matrix rgb + offset; float64 `[3, 3]`, `[3]`."""

    matrix: torch.Tensor
    offset: torch.Tensor

    @classmethod
    def between(cls, given: Colours, wanted: Colours) -> Map:
        """From colours to colours by the shortest way."""
        grey = FLAT * torch.eye(3, dtype=torch.float64)
        root = _power(given.spread + grey, 0.5)
        back = _power(given.spread + grey, -0.5)
        matrix = back @ _power(root @ (wanted.spread + grey) @ root, 0.5) @ back
        values, axes = torch.linalg.eigh(matrix)
        matrix = axes @ torch.diag(values.clamp(1 / STRETCH, STRETCH)) @ axes.T
        return cls(matrix, wanted.mean - matrix @ given.mean)

    def changes(self, colours: Colours) -> float:
        """Mean square of what it changes in a picture of such colours."""
        by = self.matrix - torch.eye(3, dtype=torch.float64)
        return float((by @ colours.spread @ by.T).trace() + (by @ colours.mean + self.offset).square().sum()) / 3

    def __call__(self, rgb: torch.Tensor) -> torch.Tensor:
        """Of `[..., 3]`, cut to 0..1."""
        return (rgb @ self.matrix.T.to(rgb) + self.offset.to(rgb)).clamp(0, 1)


SAME = Map(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))


def _power(matrix: torch.Tensor, exponent: float) -> torch.Tensor:
    """Of a symmetric positive one."""
    values, axes = torch.linalg.eigh(matrix)
    return axes @ torch.diag(values.clamp_min(1e-12) ** exponent) @ axes.T
