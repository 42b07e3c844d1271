"""Where the fit starts: splats from lidar points with the images' colours, exposures, and the sky's first guess."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from recon.log import Log, Track
from recon.objects.actors import CORNERS
from recon.views.frames import Frames
from recon.views.project import project
from scenes.camera import Camera
from scenes.gaussians import Gaussians
from scenes.harmonics import sh_from_rgb
from scenes.poses import inverse, quat_from_matrix
from scenes.trajectory import all_at

OPACITY = 0.7
THICKNESS = 0.25
"""Of a seed across its surface, as a part of its width."""

AROUND = 9
"""Points of known colour nearest to one that no picture shows, whose middle colour it takes."""


@dataclass(frozen=True)
class Cloud:
    """Points in some frame with colours in the reference camera's exposure: xyz `[N, 3]` metres, rgb `[N, 3]` 0..1."""

    xyz: np.ndarray
    rgb: np.ndarray

    def select(self, which: np.ndarray) -> Cloud:
        return Cloud(self.xyz[which], self.rgb[which])

    @staticmethod
    def cat(clouds: Sequence[Cloud]) -> Cloud:
        """The points of all of them, in order."""
        nothing = np.zeros((0, 3))
        return Cloud(np.concatenate([nothing, *(c.xyz for c in clouds)]), np.concatenate([nothing, *(c.rgb for c in clouds)]))


def colours(log: Log, frames: Frames, points: np.ndarray, taken_us: np.ndarray, movers: list[Track], local_pose=None) -> np.ndarray:
    """Colours `[C, N, 3]` of points as each camera's training frame shows them that is nearest to when their sweeps were taken, int64 us
    `[N]`; NaN where it does not.

    `local_pose(view)` gives world_from_local of points that move; the world otherwise. Points behind the boxes of `movers` are not
    seen: the lidar stands higher than the cameras and looks over cars that hide the road from them.
    """
    out = np.full((len(frames.names), len(points), 3), np.nan, dtype=np.float32)
    moments, of_moment = np.unique(taken_us, return_inverse=True)  # sweeps are few and points many
    for c in range(len(frames.names)):
        views = frames.of(c)
        times = np.array([v.time_us for v in views])
        # the points are sorted by the view that shows them
        nearest = np.abs(moments[:, None] - times[None]).argmin(1).astype(np.int32)[of_moment]
        order = np.argsort(nearest, kind="stable")
        begins = np.searchsorted(nearest[order], np.arange(len(views) + 1))
        for view, mine in zip(views, np.split(order, begins[1:-1]), strict=True):
            if not len(mine):
                continue
            cam = frames.camera(log, view)
            back = inverse(cam.world_from_cam)
            if local_pose is not None:
                placed = local_pose(view)
                if placed is None:
                    continue
                back = back @ placed
            row, column, z, seen = project(points[mine], back.numpy(), cam)
            if movers:
                seen &= z <= nearest_box(cam, movers)[row, column]
            # a point whose pixel is sky stands on an edge that the pixel misses
            seen &= view.shows_street(row, column)
            gain = frames.followed(view.time_us) if local_pose is not None else None
            out[c, mine[seen]] = view.evenly(row[seen], column[seen]) * (1 if gain is None else gain.numpy())
    return out


def nearest_box(camera: Camera, tracks: list[Track]) -> np.ndarray:
    """Depth `[H, W]`, as the lens means it, of the nearest corner of the boxes in whose image rectangles a pixel lies; inf in none."""
    depth = np.full((camera.height, camera.width), np.inf)
    paths = [track.trajectory() for track in tracks]
    there = [i for i, path in enumerate(paths) if path.covers(camera.time_us)]
    if not there:
        return depth
    poses = (inverse(camera.world_from_cam) @ torch.stack(all_at([paths[i] for i in there], camera.time_us))).numpy()
    sizes = np.array([tracks[i].size for i in there])
    corners = CORNERS * sizes[:, None]
    local = corners @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    before = local[..., 2].max(1) >= 0.2
    poses, sizes, local = poses[before], sizes[before], local[before]
    local[..., 2] = np.maximum(local[..., 2], 0.2)
    points = torch.from_numpy(local)
    pixels, depths = camera.lens.project(points).numpy(), camera.lens.depth(points).numpy().min(1)
    low = np.floor(pixels.min(1)).clip(0, [camera.width, camera.height]).astype(int)
    high = np.ceil(pixels.max(1)).clip(0, [camera.width, camera.height]).astype(int)
    for pose, size, least, (left, top), (right, bottom) in zip(poses, sizes, depths, low, high, strict=True):
        part = (slice(top, bottom), slice(left, right))
        eye = -pose[:3, :3].T @ pose[:3, 3]
        away = float(np.linalg.norm(eye - eye.clip(size * [-0.5, -0.5, 0], size * [0.5, 0.5, 1])))
        # z is least at a corner; the distance, which some lenses mean by depth, need not be
        depth[part] = np.minimum(depth[part], min(float(least), max(away, 0.2)))
    return depth


def first_exposures(seen: np.ndarray) -> np.ndarray:
    """Gains `[C, 3]` of each camera against the first, from points both see; cameras that share none follow one that does.

    The median ratio of colours between dark and clipped. A camera that shares no point with any keeps 1.
    """
    count = len(seen)
    gains = np.ones((count, 3))
    done = [0]
    while len(done) < count:
        best, found = None, 200
        for c in set(range(count)) - set(done):
            for d in done:
                both = ((seen[c] > 0.08) & (seen[c] < 0.92) & (seen[d] > 0.08) & (seen[d] < 0.92)).all(1)
                if both.sum() > found:
                    best, found = (c, d, both), both.sum()
        if best is None:
            break
        c, d, both = best
        gains[c] = np.clip(gains[d] * np.median(seen[c][both] / seen[d][both], axis=0), 0.4, 2.5)
        done.append(c)
    return gains


def merged_colours(seen: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """One colour `[N, 3]` a point in the reference exposure: from the first camera that sees it; NaN where none does."""
    out = np.full(seen.shape[1:], np.nan)
    for c in range(len(seen)):
        empty = np.isnan(out[:, 0])
        out[empty] = seen[c][empty] / gains[c]
    return out


def thin(cloud: Cloud, distance: np.ndarray, budget: int) -> tuple[Cloud, np.ndarray]:
    """At most about `budget` points: one a voxel, whose side grows with its `distance` `[N]`. Also returns their voxels' sides.

    The side is k times the distance, at least 4 cm, in half octaves; k is found by bisection so that the budget is met.
    """
    low, high = 1e-4, 0.3
    chosen, sides = _voxels(cloud.xyz, distance, low)
    if len(chosen) > budget:
        for _ in range(10):
            k = np.sqrt(low * high)
            chosen, sides = _voxels(cloud.xyz, distance, k)
            low, high = (k, high) if len(chosen) > budget else (low, k)
    return cloud.select(chosen), sides[chosen]


def _voxels(xyz: np.ndarray, distance: np.ndarray, k: float) -> tuple[np.ndarray, np.ndarray]:
    level = np.round(2 * np.log2(np.maximum(k * distance / 0.04, 1.0))).astype(np.int64)
    side = 0.04 * 2.0 ** (level / 2)
    return one_a_voxel(xyz, side, level), side


def one_a_voxel(xyz: np.ndarray, side: np.ndarray | float, level: np.ndarray | int = 0) -> np.ndarray:
    """Indices, in their order, of the first of points `[N, 3]` in each voxel of `side` metres, one or `[N]`; of other `level`s, one or
    `[N]`, voxels are others."""
    key = np.broadcast_to(np.int64(level), len(xyz))
    for places in xyz.T:  # a long drive's cells, of 4 cm, have too many bits to be packed blindly
        cell = np.floor(places / side).astype(np.int64)
        cell -= cell.min(initial=0)
        key = key * (int(cell.max(initial=0)) + 1) + cell
    return np.sort(np.unique(key, return_index=True)[1])


def middle_colours(places: np.ndarray, rgb: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Channel by channel the middle of the colours `[N, 3]` of the `AROUND` of `places` `[N, D]` nearest to each of `at` `[M, D]`."""
    nearest = cKDTree(places).query(at, range(1, min(AROUND, len(places)) + 1), workers=2)[1]
    return np.median(rgb[nearest], axis=1)


def fewer(splats: Gaussians, count: float) -> Gaussians:
    """At most so many of the splats, evenly taken, and as much wider as they are fewer."""
    if len(splats) <= count:
        return splats
    chosen = torch.linspace(0, len(splats) - 1, int(count)).round().long()
    some = splats.select(chosen)
    return replace(some, log_scales=some.log_scales + math.log(len(splats) / max(len(some), 1)) / 2)


def alike(means: np.ndarray, rgb: np.ndarray | float, scales: Sequence[float], logit: float, sh_count: int) -> Gaussians:
    """Splats at `means` `[N, 3]`, of colours rgb (`[N, 3]`, or one for all) from all sides, whose axes are the frame's: all of the same
    standard deviations `scales` (3 of them, in metres) and opacity logit."""
    n = len(means)
    sh = torch.zeros(n, sh_count, 3)
    sh[:, 0] = sh_from_rgb(rgb if isinstance(rgb, float) else torch.from_numpy(rgb).float())
    return Gaussians(
        torch.from_numpy(means).float(),
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        torch.tensor(scales).log().repeat(n, 1),
        torch.full((n,), logit),
        sh,
    )


def splats_from(cloud: Cloud, sides: np.ndarray, sh_count: int, largest: np.ndarray | float) -> Gaussians:
    """A flat splat a point: as wide as its neighbours are far, thin across the surface that the neighbours span.

    Widths lie between a third of the point's voxel side and `largest` metres; normals by principal components of 10 neighbours.
    """
    n = len(cloud.xyz)
    if n == 0:
        return Gaussians.empty(sh_count)
    count = min(10, n)
    near, index = cKDTree(cloud.xyz).query(cloud.xyz, k=count, workers=2)
    near, index = near.reshape(n, count), index.reshape(n, count)
    width = np.clip(near[:, 1:4].mean(1) if count > 3 else sides, np.maximum(sides / 3, 0.01), largest) * 0.8
    rotation = np.broadcast_to(np.eye(3), (n, 3, 3))
    flat = np.zeros(n, dtype=bool)
    if count >= 6:
        around = cloud.xyz[index] - cloud.xyz[index].mean(1, keepdims=True)
        values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
        flat = values[:, 0] < 0.1 * values[:, 1]
        vectors = vectors * np.sign(np.linalg.det(vectors))[:, None, None]
        rotation = np.where(flat[:, None, None], vectors, rotation)
    scales = np.repeat(width[:, None], 3, 1)
    scales[flat, 0] *= THICKNESS
    sh = torch.zeros(n, sh_count, 3)
    sh[:, 0] = sh_from_rgb(torch.from_numpy(cloud.rgb).float())
    return Gaussians(
        torch.from_numpy(cloud.xyz).float(),
        quat_from_matrix(torch.from_numpy(np.array(rotation))).float(),
        torch.from_numpy(np.log(scales)).float(),
        torch.full((n,), float(np.log(OPACITY / (1 - OPACITY)))),
        sh,
    )
