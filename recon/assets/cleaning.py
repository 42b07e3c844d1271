"""What does not belong to a cut-out object: road, its neighbours' splats, floaters. Splats stand in the frame of its box.

Outliers and clusters are found with scipy's k-d tree: open3d does the same two things, but these two alone are
not worth so large a package.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scenes.gaussians import Gaussians
from scenes.poses import matrix_from_quat

NEIGHBOURS = 8
"""Nearest splats whose mean distance tells how alone a splat is."""

ALONE = 3.0
"""Standard deviations of that distance's logarithm above its mean from which a splat is an outlier."""

GAP = 0.25
"""Metres between two splats from which they are not of one cluster."""

PART = 0.05
"""Of all splats that another cluster must have to be a part of the object: a mirror, a wheel, the bed of a pickup."""

ROAD = 0.2
"""Metres above the ground below which a splat that lies flat is road."""

FLAT = 2.5
"""Times as wide as high from which a splat lies flat."""


def cleaned(splats: Gaussians, size: torch.Tensor) -> Gaussians:
    """The splats of an object in a box `[length, width, height]`: without flat ones near the ground, outliers, and clusters of others."""
    splats = splats.select(~lies_on_road(splats))
    splats = splats.select(~outliers(splats))
    return splats.select(of_object(splats, size))


def lies_on_road(splats: Gaussians) -> torch.Tensor:
    """Mask `[N]` of splats near the ground that are much wider than high: patches of asphalt, and needles that lie on it."""
    spread = (matrix_from_quat(splats.quats).square() * splats.log_scales.exp().square()[:, None]).sum(2).sqrt()
    return (splats.means[:, 2] < ROAD) & (spread[:, :2].amax(1) > FLAT * spread[:, 2])


def outliers(splats: Gaussians) -> torch.Tensor:
    """Mask `[N]` of splats much farther from their neighbours than others are: statistical outlier removal (Rusu 2010), on logarithms,
    since splats are dense on detail and sparse on doors."""
    if len(splats) <= NEIGHBOURS:
        return torch.zeros(len(splats), dtype=torch.bool)
    points = splats.means.double().numpy()
    distance = np.log(cKDTree(points).query(points, NEIGHBOURS + 1)[0][:, 1:].mean(1).clip(1e-6))
    return torch.from_numpy(distance > distance.mean() + ALONE * distance.std().clip(0.15))


def of_object(splats: Gaussians, size: torch.Tensor) -> torch.Tensor:
    """Mask `[N]` of the largest cluster and of those that are a part: large enough, and with their middle well inside the box."""
    if not len(splats):
        return torch.zeros(0, dtype=torch.bool)
    points = splats.means.double().numpy()
    pairs = cKDTree(points).query_pairs(GAP, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    count, label = connected_components(graph, directed=False)
    sizes = np.bincount(label, minlength=count)
    middles = np.stack([np.bincount(label, points[:, axis], count) / sizes for axis in range(2)], 1)
    within = (np.abs(middles) < 0.4 * size[:2].numpy()).all(1)
    keep = (sizes >= PART * len(points)) & within
    keep[sizes.argmax()] = True
    return torch.from_numpy(keep[label])
