"""Which ground nothing is seen through, and points of pictures alone that seem to lie under it.

What drives ahead as fast as the camera hardly moves in its pictures, as if it were far away: below the horizon that is far under the road.
So do dashes that the car passes at the rate of its pictures. Where points show where the road is, nothing is under it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from recon.ground import above_ground, cells_of, estimate_ground
from recon.log import Log, SparsePoints
from recon.seeds.ground_rays import ground_hits
from recon.way import Path
from scenes.ground import Ground
from scenes.trajectory import Trajectory

LYING, SHARE, FEWEST = 0.15, 0.25, 50
"""Metres off a road up to which points lie on it, which part of those along the path must, and how many, for it to be known."""

UNDER = 0.3
"""Metres under it from which on a point is not of its surface."""

WIDE, LIMIT, ON = 5.0, 8.0, 40.0
"""Metres beside the path up to which points under the road are false, and up to which nothing is looked for there; and beyond its ends."""

CLOSE, SOME = 1.5, 3
"""Metres each way from a place within which so many points that lie on the ground show it there, too."""


def known_ground(points: np.ndarray, ground: Ground, ego: Trajectory, wide: float = LIMIT) -> np.ndarray:
    """In which cells `[Y, X]` of a ground nothing can be seen through it: so many metres beside a body's path, and where several of points
    `[N, 3]` lie on it; none where those along the path do not, so that it may be anywhere."""
    shape, path = tuple(ground.heights.shape), Path(ego).places
    on = np.arange(1.0, ON)[:, None]
    ends = path[0] + on * (path[0] - path[1]), path[-1] + on * (path[-1] - path[-2])
    driven, further = _beside(path, ground) < WIDE, _beside(np.concatenate([path, *ends]), ground) < wide
    cells = cells_of(points, ground)
    lying, near = np.abs(above_ground(points, ground)) < LYING, driven[cells]
    if (lying & near).sum() < FEWEST or lying[near].mean() < SHARE:
        return np.zeros(shape, bool)
    count = np.bincount(np.ravel_multi_index(cells, shape)[lying], minlength=ground.heights.numel()).reshape(shape)
    side = 2 * round(CLOSE / ground.cell) + 1
    return further | (ndimage.uniform_filter(count.astype(np.float64), side, mode="constant") * side**2 > SOME - 0.5)


def without_sunken(sparse: SparsePoints, log: Log, ego: Trajectory) -> SparsePoints:
    """The points without those that most of the pictures that show them see through known ground (`known_ground`) along a body's path; all
    of them where they are not metric."""
    if not log.meta.get("metric", True):
        return sparse
    ground = estimate_ground(sparse.xyz, ego)
    known = known_ground(sparse.xyz, ground, ego, WIDE)
    sunken = above_ground(sparse.xyz, ground) < -UNDER
    through, seen = np.zeros((2, len(sparse.xyz)))
    for name, frames in sparse.seen.items():
        eyes = log.camera(name).world_from_cam[:, :3, 3].numpy()
        for eye, shown in zip(eyes, frames, strict=True):
            low = shown[sunken[shown]]
            rays = sparse.xyz[low] - eye
            hits = ground_hits(eye, rays, ground)
            met = eye + np.where(np.isfinite(hits), hits, 0.0)[:, None] * rays
            seen[low] += 1
            through[low] += (hits < 1) & known[cells_of(met, ground)]
    kept = through <= 0.5 * seen
    order = np.cumsum(kept) - 1
    left = {name: tuple(order[s[kept[s]]] for s in frames) for name, frames in sparse.seen.items()}
    return replace(sparse, xyz=sparse.xyz[kept], seen=left)


def _beside(places: np.ndarray, ground: Ground) -> np.ndarray:
    """Metres `[Y, X]` from a ground's cells to the nearest of places `[N, 3]`."""
    there = np.zeros(tuple(ground.heights.shape), bool)
    there[cells_of(places, ground)] = True
    return ndimage.distance_transform_edt(~there) * ground.cell
