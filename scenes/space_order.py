"""An order of splats in memory that follows space."""

from __future__ import annotations

import torch

LOOKED_AT = 1_000_000
"""Points that the extent is taken from."""


def space_order(points: torch.Tensor) -> torch.Tensor:
    """Indices `[N]` of points `[N, 3]` along the Z-order curve (Morton 1966) through a grid of 1024 cells a side around all but the
    farthest thousandth: neighbours in space are near in memory, so that runs of splats have tight bounds (`render.cull`)."""
    if not len(points):
        return torch.empty(0, dtype=torch.long, device=points.device)
    some = points[:: -(-len(points) // LOOKED_AT)].detach()
    low, high = some.quantile(0.001, 0), some.quantile(0.999, 0)
    cells = ((points.detach() - low) / (high - low).clamp_min(1e-9) * 1023).clamp(0, 1023).long()
    code = torch.zeros(len(points), dtype=torch.long, device=points.device)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code.argsort(stable=True)
