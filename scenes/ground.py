"""The ground as a height field: where an inserted asset stands."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from scenes.checks import check_tensor


@dataclass(frozen=True)
class Ground:
    """Heights `[Y, X]` float32 in metres at world points `origin + cell * (column, row)`; every cell is filled."""

    heights: torch.Tensor
    origin: tuple[float, float]
    cell: float

    def __post_init__(self):
        check_tensor("heights", self.heights, ("Y", "X"), torch.float32)
        if min(self.heights.shape) < 2:
            raise ValueError(f"a ground must be at least 2x2 cells, got {tuple(self.heights.shape)}")
        if not self.cell > 0:
            raise ValueError(f"cell must be positive metres, got {self.cell}")

    def height(self, xy: torch.Tensor) -> torch.Tensor:
        """Heights `[...]` float64 at world points `[..., 2]`: bilinear; beyond the edge, the edge's height."""
        ny, nx = self.heights.shape
        at = (xy.to(torch.float64) - torch.tensor(self.origin, dtype=torch.float64)) / self.cell
        cx, cy = at[..., 0].clamp(0, nx - 1), at[..., 1].clamp(0, ny - 1)
        i, j = cx.floor().clamp_max(nx - 2).long(), cy.floor().clamp_max(ny - 2).long()
        fx, fy = cx - i, cy - j
        low, low_next, high, high_next = (self.heights[r, c].to(torch.float64) for r in (j, j + 1) for c in (i, i + 1))
        near = low * (1 - fx) + low_next * fx
        far = high * (1 - fx) + high_next * fx
        return near * (1 - fy) + far * fy
