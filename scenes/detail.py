"""Level of detail: splats that are smaller than a pixel where they are seen from are merged."""

from __future__ import annotations

import torch

from scenes.gaussians import Gaussians
from scenes.poses import matrix_from_quat, quat_from_matrix
from scenes.scene import Scene
from scenes.trajectory import Trajectory

DENSEST = 0.995
"""Opacity of a merged splat at most."""

ASIDE = 5.0
"""Metres off the recorded path from which an asset is still drawn in full: half of itself, and a shift to the next lane."""

NEAREST = 1.0
"""Metres from which it is, wherever it stands."""


def as_seen(splats: Gaussians, scene: Scene, path: Trajectory) -> Gaussians:
    """Splats that go along a path, without what the drive's cameras cannot tell apart: that which half a pixel holds."""
    return coarser(splats, finest_pixel(scene, path) / 2)


def finest_pixel(scene: Scene, path: Trajectory) -> float:
    """Metres that a pixel of the sharpest camera spans at the nearest that a body's path comes to the drive, seen from `ASIDE` nearer."""
    if not scene.rig:
        return 1e-3
    focal = max(max(camera.lens.focal()) for camera in (*scene.rig.values(), *scene.own.values()))
    moments = scene.ego.times_us[[path.covers(int(t)) for t in scene.ego.times_us]] if len(path) > 1 else scene.ego.times_us
    gaps = [float((scene.ego.at(int(t))[:3, 3] - path.at(int(t))[:3, 3]).norm()) for t in moments]
    return max(min(gaps, default=0.0) - ASIDE, NEAREST) / focal


def coarser(splats: Gaussians, cell: float) -> Gaussians:
    """Splats in which those of one cubic cell, `cell` metres wide, are one; where a cell holds only one, it stays as it is.

    A merged splat has the mean, covariance and colour of its parts, weighed by what they cover (opacity times the area of their two longest
    axes), and covers as much as they do together. ValueError for a cell that is not positive.
    """
    if not cell > 0:
        raise ValueError(f"a cell must be wider than 0 m, got {cell:g}")
    places = torch.floor(splats.means.double() / cell).long()
    _, group, count = torch.unique(places, dim=0, return_inverse=True, return_counts=True)
    alone = count[group] == 1
    if alone.all():
        return splats
    return Gaussians.cat([splats.select(alone), _merged(splats.select(~alone), torch.unique(group[~alone], return_inverse=True)[1])])


def _merged(splats: Gaussians, group: torch.Tensor) -> Gaussians:
    """One splat a group; `group` `[N]` counts from 0 without gaps."""
    size = int(group.max()) + 1
    scales, opacity = splats.log_scales.double().exp(), torch.sigmoid(splats.logit_opacities.double())
    cover = opacity * _area(scales)
    share = cover / torch.zeros(size, dtype=torch.float64).index_add(0, group, cover)[group]

    def mean_of(values: torch.Tensor) -> torch.Tensor:
        flat = values.double().flatten(1) * share[:, None]
        return torch.zeros(size, flat.shape[1], dtype=torch.float64).index_add(0, group, flat).reshape(size, *values.shape[1:])

    means = mean_of(splats.means)
    axes = matrix_from_quat(splats.quats.double()) * scales[:, None]
    off = splats.means.double() - means[group]
    values, vectors = torch.linalg.eigh(mean_of(axes @ axes.mT + off[:, :, None] * off[:, None]))
    vectors = vectors * torch.linalg.det(vectors).sign()[:, None, None]
    wide = values.clamp_min(1e-12).sqrt()
    dense = (torch.zeros(size, dtype=torch.float64).index_add(0, group, cover) / _area(wide)).clamp(1e-6, DENSEST)
    fields = means, quat_from_matrix(vectors), wide.log(), torch.logit(dense), mean_of(splats.sh)
    return Gaussians(*(f.float() for f in fields))


def _area(scales: torch.Tensor) -> torch.Tensor:
    """Of each splat's two longest axes `[N]`."""
    return scales.prod(1) / scales.amin(1)
