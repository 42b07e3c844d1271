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

WIDE = 0.75
"""Standard deviation of one along the ground, in spacings: half way between four they hide all but a fiftieth of what is below."""

REACH = 10.0
"""Metres from the path that it covers."""

NEAR_GROUND = 0.25
"""Metres from the ground's height within which a point belongs to the ground."""

LYING = 0.08
"""Metres from the ground's height within which a point is surely the ground's: above lie tyres and the sills of parked cars."""

ALIKE = 9
"""Points beside a splat whose middle colour, channel by channel, it takes."""

LOGIT = 2.0
"""Of the opacity."""


def carpet(cloud: Cloud, ground: Ground, ego: Trajectory, sh_count: int) -> Gaussians:
    """Flat splats on the ground within `REACH` of the path wherever `cloud` has no ground point near, coloured as what lies on it there."""
    off = np.abs(cloud.xyz[:, 2] - ground.height(torch.from_numpy(cloud.xyz[:, :2])).numpy())
    own = off < NEAR_GROUND
    lying = off < (LYING if (off < LYING).any() else NEAR_GROUND)
    path = ego.world_from_body[:, :2, 3].numpy()
    low, high = path.min(0) - REACH, path.max(0) + REACH
    grid = np.stack(np.meshgrid(*(np.arange(a, b, SPACING) for a, b in zip(low, high, strict=True))), -1).reshape(-1, 2)
    grid = grid[cKDTree(path).query(grid)[0] < REACH]
    if not own.any() or not len(grid):
        return Gaussians.empty(sh_count)
    away, _ = cKDTree(cloud.xyz[own, :2]).query(grid, workers=2)
    xy = grid[away > 0.75 * SPACING]
    _, nearest = cKDTree(cloud.xyz[lying, :2]).query(xy, range(1, min(ALIKE, int(lying.sum())) + 1), workers=2)
    rgb = np.median(cloud.rgb[lying][nearest], axis=1)
    n = len(xy)
    means = np.column_stack([xy, ground.height(torch.from_numpy(xy)).numpy()])
    sh = torch.zeros(n, sh_count, 3)
    sh[:, 0] = sh_from_rgb(torch.from_numpy(rgb).float())
    return Gaussians(
        torch.from_numpy(means).float(),
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        torch.tensor([WIDE * SPACING, WIDE * SPACING, 0.1 * SPACING]).log().repeat(n, 1),
        torch.full((n,), LOGIT),
        sh,
    )
