"""How much of the sky's light an asset keeps from the places around it: traced once, then looked up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from render.tracer import Blockers
from scenes.gaussians import Gaussians
from scenes.poses import matrix_from_quat

CELLS = 6000
"""Of one level of a field: its cell is as coarse as that asks for."""

LEVELS = 4
"""Heights at which light is traced, from the ground to the asset's own."""

FARTHEST = 30.0
"""Metres from an asset to the end of its longest shadow."""

BESIDE = 1.5
"""Metres around a footprint that are traced whatever the light."""

FADE = 4
"""Cells within which a field fades towards its box's sides, so that no edge shows where it ends."""

SOLID = 0.3
"""Opacity from which a splat blocks light."""

SIGMAS = 1.3
"""Half the side of the square that stands for a splat, in its standard deviations: there it has lost half of its opacity."""

MOST = 20_000
"""Splats of one asset, or scene, that block light."""


@dataclass(frozen=True)
class Box:
    """Where a shadow can fall, in the asset's frame: corners low, high `[3]` in metres, the ground at 0."""

    low: torch.Tensor
    high: torch.Tensor

    def corners(self) -> torch.Tensor:
        """float64 `[8, 3]`."""
        axes = torch.stack([self.low, self.high], 1).double()
        return torch.cartesian_prod(*axes)

    def edges(self, count: int) -> torch.Tensor:
        """float64 `[12 count, 3]`: places along each edge, its corners among them."""
        corners = self.corners()  # the bits of a corner's index say on which side of the box it is
        begins, ends = zip(*((i, i | side) for side in (1, 2, 4) for i in range(8) if not i & side), strict=True)
        along = torch.linspace(0, 1, count, dtype=torch.float64)[:, None, None]
        return torch.lerp(corners[list(begins)], corners[list(ends)], along).reshape(-1, 3)


@dataclass(frozen=True)
class Field:
    """The part of the light that is blocked, `[Z, Y, X]` float32, over a box in the asset's frame; nothing is beyond it."""

    blocked: torch.Tensor
    box: Box


def shadow_box(size: torch.Tensor, directions: torch.Tensor) -> Box:
    """Where the shadow of a box `[length, width, height]` falls under light from unit `directions` `[K, 3]`, but for faint outskirts."""
    height = float(size[2])
    reach = (-directions[:, :2] / directions[:, 2:].clamp_min(1e-3) * height).float()
    reach = reach * (FARTHEST / reach.norm(dim=1, keepdim=True).clamp_min(FARTHEST))
    half = size[:2].float() / 2
    low = torch.minimum(reach.quantile(0.03, 0) - half, -half - BESIDE)
    high = torch.maximum(reach.quantile(0.97, 0) + half, half + BESIDE)
    fade = FADE * _cell(high - low)  # beyond the tip of the shadow, not over it
    low, high = low - fade, high + fade
    return Box(torch.cat([low, torch.zeros(1, dtype=torch.float32)]), torch.cat([high, torch.tensor([height], dtype=torch.float32)]))


def trace_field(splats: Gaussians, box: Box, directions: torch.Tensor, weights: torch.Tensor) -> Field:
    """The light from `directions` `[K, 3]` of `weights` `[K]` that splats keep from the places of a box, all in one frame."""
    blockers = Blockers(squares(splats))
    extent = (box.high - box.low)[:2]
    counts = [max(2, round(float(e) / _cell(extent)) + 1) for e in extent]
    axes = [
        torch.linspace(float(a), float(b), n, dtype=torch.float32) for a, b, n in zip(box.low, box.high, [*counts, LEVELS], strict=True)
    ]
    axes[2][0] = 0.02  # above what is left of the road in an asset
    z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    points = torch.stack([x, y, z], -1).reshape(-1, 3)
    blocked = _smooth((1 - blockers.open_share(points, directions, weights, FARTHEST)).reshape(z.shape))
    fade = [(torch.minimum(torch.arange(n), torch.arange(n).flip(0)).float() / FADE).clamp_max(1) for n in counts]
    return Field(blocked * fade[1][:, None] * fade[0], box)


def _smooth(blocked: torch.Tensor) -> torch.Tensor:
    """Levels `[Z, Y, X]` without the stairs that the grid's cells leave along a shadow's slanted edges."""
    near = torch.tensor([0.25, 0.5, 0.25], dtype=torch.float32)
    padded = torch.nn.functional.pad(blocked[:, None], (1, 1, 1, 1), mode="replicate")
    return torch.nn.functional.conv2d(padded, (near[:, None] * near)[None, None])[:, 0]


def _cell(extent: torch.Tensor) -> float:
    """Metres of a cell of a field of so many metres `[2]` along x and y."""
    return max(0.08, float(extent.prod() / CELLS) ** 0.5)


def squares(splats: Gaussians) -> np.ndarray:
    """Triangles `[F, 3, 3]` of three squares, across each other, for every solid splat; of more than `MOST` every few, larger in return."""
    solid = splats.select(torch.sigmoid(splats.logit_opacities) > SOLID)
    every = max(1, -(-len(solid) // MOST))
    solid = solid.select(torch.arange(0, len(solid), every))
    axes = matrix_from_quat(solid.quats) * (SIGMAS * every**0.5 * solid.log_scales.exp())[:, None]
    triangles = []
    for i, j in ((0, 1), (1, 2), (2, 0)):  # of a flat splat two of them have no area, and block nothing
        a, b = axes[:, :, i], axes[:, :, j]
        corners = torch.stack([solid.means + s * a + t * b for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))], 1)
        triangles.append(corners[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 3))
    return torch.cat(triangles).detach().cpu().numpy()
