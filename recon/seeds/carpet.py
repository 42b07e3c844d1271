"""Ground that neither lidar nor cameras saw, under and beside the car's path: a shifted camera looks straight at it."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from recon.seeds.points import Cloud
from scenes.gaussians import Gaussians
from scenes.ground import Ground
from scenes.harmonics import sh_from_rgb
from scenes.trajectory import Trajectory

SPACING = 0.3
"""Metres between the splats of the carpet."""

REACH = 10.0
"""Metres from the path that it covers."""

NEAR_GROUND = 0.25
"""Metres from the ground's height within which a point belongs to the ground."""

LOGIT = 2.0
"""Of the opacity: splats that overlap by half close the ground."""


def carpet(cloud: Cloud, ground: Ground, ego: Trajectory, sh_count: int) -> Gaussians:
    """Flat splats on the ground within `REACH` of the path wherever `cloud` has no ground point near, coloured as the nearest has them."""
    z = ground.height(torch.from_numpy(cloud.xyz[:, :2])).numpy()
    own = np.abs(cloud.xyz[:, 2] - z) < NEAR_GROUND
    path = ego.world_from_body[:, :2, 3].numpy()
    low, high = path.min(0) - REACH, path.max(0) + REACH
    grid = np.stack(np.meshgrid(*(np.arange(a, b, SPACING) for a, b in zip(low, high, strict=True))), -1).reshape(-1, 2)
    grid = grid[cKDTree(path).query(grid)[0] < REACH]
    if not own.any() or not len(grid):
        return Gaussians.empty(sh_count)
    away, nearest = cKDTree(cloud.xyz[own, :2]).query(grid, workers=2)
    bare = away > 0.75 * SPACING
    xy, rgb = grid[bare], cloud.rgb[own][nearest[bare]]
    n = len(xy)
    means = np.column_stack([xy, ground.height(torch.from_numpy(xy)).numpy()])
    sh = torch.zeros(n, sh_count, 3)
    sh[:, 0] = sh_from_rgb(torch.from_numpy(rgb).float())
    return Gaussians(
        torch.from_numpy(means).float(),
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        torch.tensor([0.6 * SPACING, 0.6 * SPACING, 0.1 * SPACING]).log().repeat(n, 1),
        torch.full((n,), LOGIT),
        sh,
    )
