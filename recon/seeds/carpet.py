"""Ground that neither lidar nor cameras saw, under and beside the car's path: a shifted camera looks straight at it."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from recon.ground import above_ground
from recon.seeds.points import Cloud, alike, middle_colours
from scenes.gaussians import Gaussians
from scenes.ground import Ground
from scenes.trajectory import Trajectory

SPACING, WIDER = 0.3, 1.05
"""Metres between the splats of the carpet, and how much farther apart they are laid at least where these would be too many."""

TILE = 32
"""Spacings along a side of the squares, around the path, in which places are looked for."""

WIDE = 0.75
"""Standard deviation of one along the ground, in spacings: half way between four they hide all but a fiftieth of what is below."""

REACH = 10.0
"""Metres from the path that it covers."""

NEAR_GROUND = 0.25
"""Metres from the ground's height within which a point belongs to the ground."""

KNOWN = 0.1
"""Metres, the sides of cells in which a point of the ground makes it known."""

LYING = 0.08
"""Metres from the ground's height within which a point is surely the ground's: above lie tyres and the sills of parked cars."""

LOGIT = 2.0
"""Of the opacity."""


def carpet(shown: np.ndarray, cloud: Cloud, ground: Ground, ego: Trajectory, sh_count: int, most: int) -> Gaussians:
    """Flat splats on the ground within `REACH` of the path wherever none of the points `shown` `[N, 3]` lies on it near, coloured as what
    of `cloud` does; `most` at most, farther apart on a long way."""
    off = np.abs(above_ground(cloud.xyz, ground))
    lying = off < (LYING if (off < LYING).any() else NEAR_GROUND)
    own = np.unique(np.floor(shown[np.abs(above_ground(shown, ground)) < NEAR_GROUND, :2] / KNOWN), axis=0)
    path = ego.world_from_body[:, :2, 3].numpy()
    if not len(own) or not lying.any() or most < 1:
        return Gaussians.empty(sh_count)
    known, spacing = cKDTree((own + 0.5) * KNOWN), SPACING
    while len(xy := _bare(path, known, spacing)) > most:
        spacing *= max(WIDER, (len(xy) / most) ** 0.5)
    if not len(xy):
        return Gaussians.empty(sh_count)
    rgb = middle_colours(cloud.xyz[lying, :2], cloud.rgb[lying], xy)
    means = np.column_stack([xy, ground.height(torch.from_numpy(xy)).numpy()])
    return alike(means, rgb, (WIDE * spacing, WIDE * spacing, 0.1 * spacing), LOGIT, sh_count)


def _bare(path: np.ndarray, known: cKDTree, spacing: float) -> np.ndarray:
    """Places `[N, 2]` of a grid within `REACH` of a path `[P, 2]` that lie apart from all that are known, row by row.

    They are sought in squares around the path: a long one's bounding box holds many more.
    """
    low = path.min(0) - REACH
    across = int(np.ceil(REACH / (TILE * spacing)))
    reach = np.arange(-across, across + 1)
    tiles = np.unique(np.floor((path - low) / (TILE * spacing)).astype(np.int64), axis=0)
    tiles = np.unique((tiles[:, None] + np.stack(np.meshgrid(reach, reach), -1).reshape(-1, 2)).reshape(-1, 2), axis=0)
    inner = np.stack(np.meshgrid(np.arange(TILE), np.arange(TILE)), -1).reshape(-1, 2)
    cells = (tiles[:, None] * TILE + inner).reshape(-1, 2)
    cells = cells[(cells >= 0).all(1)]
    grid = low + spacing * cells
    near = cKDTree(path).query(grid, distance_upper_bound=REACH)[0] < REACH
    cells, grid = cells[near], grid[near]
    bare = np.flatnonzero(known.query(grid, workers=2)[0] > 0.75 * spacing)
    return grid[bare[np.lexsort(cells[bare].T)]]
