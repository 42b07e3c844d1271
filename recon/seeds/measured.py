"""Depth that lidar, or other pictures, measured: what a fit's own depth is held to, on a coarse grid of the views that have any."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage

from recon.log import Log, Sweep, Track
from recon.objects.actors import Split
from recon.seeds.points import nearest_box
from recon.seeds.stereo import WIDTH, Plate
from recon.views.frames import Frames
from recon.views.project import project
from recon.views.view import View
from render.rays import camera_rays, world_directions
from scenes.camera import Camera
from scenes.poses import inverse
from scenes.trajectory import Trajectory

SOON_US, LATE_US, WAY = 100_000, 500_000, 1.0
"""How far a sweep may be from a picture that it measures; and how far, where the body has gone less than so many metres by then: a slow car
sees the same."""

HIDING, AROUND = 1.1, (9, 5)
"""How many times nearer a point within so many rows and columns must be to hide another: lidar looks over what hides it from cameras."""

ROAD, UNDER, LOWER = 1.2, 8.0, 0.05
"""Metres above the road that a car's camera stands at least: below the horizon what a lower point hides rises more steeply from there than
a road does, whose near end hides nothing of its far one. From some 50 metres on nothing lower hides anything. A robot's stands as far above
its floor as above this part of the points within so many metres."""

SLACK = 0.05
"""Part of a depth by which it may be off at little cost; what a mistake costs grows with its logarithm from there on."""

LIDAR, PICTURES = 0.005, 0.02
"""What mistakes weigh beside a picture's loss. Lidar is where splats begin, and more would cost held-out pictures more than depth gains: on
drive 002's front camera 0.13 dB for 2.6 % that become 1.2, and at 0.02 0.23 dB for 0.8. What pictures agree on begins farther off, and
costs nothing. Twice as much for lidar would cost KITTI 0009 0.5 dB, and its depth would be 1.6 % off for 2.0."""


@dataclass(frozen=True)
class Measured:
    """By a view's camera and index: depth, as the view's lens means it, float16 `[h, w]`, NaN where nobody knows; and what a mistake
    weighs."""

    views: dict[tuple[int, int], torch.Tensor]
    weight: float

    def without(self, known: Measured) -> Measured:
        """The depths of pixels that `known` says nothing of."""
        other = {which: known.views[which].isfinite() for which in self.views if which in known.views}
        views = {which: depth.masked_fill(other[which], torch.nan) if which in other else depth for which, depth in self.views.items()}
        return Measured(views, self.weight)

    def completed(self, other: Measured) -> Measured:
        """These depths, and those of another where there are none; mistakes weigh as they did."""
        rest = other.without(self).views
        both = {which: torch.where(depth.isfinite(), depth, rest.get(which, depth)) for which, depth in self.views.items()}
        return Measured(rest | both, self.weight)

    def to(self, device: torch.device | str) -> Measured:
        """The same depths on a device."""
        return Measured({which: depth.to(device) for which, depth in self.views.items()}, self.weight)


def nearer(measured: Sequence[Measured], part: float) -> float:
    """Depth than which this part of what is known of the views is nearer; infinite where nothing is known."""
    known = [depth[::4, ::4].flatten() for m in measured for depth in m.views.values()]
    depths = torch.cat([torch.zeros(0), *(d[d.isfinite()].float().cpu() for d in known)])
    return float(np.quantile(depths.numpy(), part)) if len(depths) else np.inf


def grid_of(camera: Camera) -> Camera:
    """A view's camera on the grid, as fine as plates are."""
    return camera.resized(WIDTH, max(1, round(WIDTH * camera.height / camera.width)))


def by_lidar(log: Log, frames: Frames, sweeps: Sequence[Sweep], split: Split, movers: list[Track]) -> Measured:
    """What the sweep nearest to each training view measured of what stands still, and no mover hides; split: the sweeps' points."""
    measured = {}
    for _, static, view, camera in _soon(log, frames, sweeps, split):
        stands = min(ROAD, _stands(camera.world_from_cam[:3, 3].numpy(), static))
        measured[view.camera, view.index] = as_known(nearest_points(static, camera, nearest_box(camera, movers), stands))
    return Measured(measured, LIDAR)


def _stands(eye: np.ndarray, points: np.ndarray) -> float:
    """Metres of an eye `[3]` above what points `[N, 3]` show of the ground around; infinite where they show none below it."""
    low = points[np.linalg.norm(points[:, :2] - eye[:2], axis=1) < UNDER, 2]
    height = eye[2] - np.quantile(low, LOWER) if len(low) else 0.0
    return float(height) if height > 0 else np.inf


def by_lidar_of_movers(log: Log, frames: Frames, sweeps: Sequence[Sweep], split: Split) -> Measured:
    """What the sweep nearest to each training view measured of what moves, where it is at the view's moment and nothing hides it."""
    measured = {}
    for sweep, static, view, camera in _soon(log, frames, sweeps, split):
        moving = split.moved(sweep.index, view.time_us)
        if not len(moving):
            continue
        struck = {name for name, (_, of) in split.actors.items() if (of == sweep.index).any()}
        unseen = nearest_box(camera, [t for t in split.tracks if t.name not in struck])
        depth, first = (nearest_points(p, camera, unseen) for p in (moving, np.concatenate([moving, static])))
        measured[view.camera, view.index] = as_known(np.where(depth < HIDING * first, depth, np.nan))
    return Measured(measured, LIDAR)


def _soon(log: Log, frames: Frames, sweeps: Sequence[Sweep], split: Split) -> Iterator[tuple[Sweep, np.ndarray, View, Camera]]:
    """Training views and their cameras on the grid, each with the sweep nearest to it, if soon enough, and that one's static points."""
    times = np.array([s.time_us for s in sweeps])
    near: dict[int, list[View]] = {}
    for view in frames.training() if len(times) else []:
        k = int(np.abs(times - view.time_us).argmin())
        if _measures(log.ego, int(times[k]), view.time_us):
            near.setdefault(k, []).append(view)
    for k, views in near.items():
        static = split.static[split.static_sweep == sweeps[k].index]
        for view in views:
            yield sweeps[k], static, view, grid_of(frames.camera(log, view))


def _measures(ego: Trajectory, sweep_us: int, picture_us: int) -> bool:
    """Whether a sweep is near enough to a picture."""
    late = abs(sweep_us - picture_us)
    return late <= SOON_US or (late <= LATE_US and float((ego.near(sweep_us) - ego.near(picture_us))[:3, 3].norm()) <= WAY)


def nearest_points(points: np.ndarray, camera: Camera, before: np.ndarray, stands: float = ROAD) -> np.ndarray:
    """Depth `[h, w]` of points `[N, 3]` that a camera sees which `stands` so many metres above the road, NaN where it sees none; neither
    behind others, which a road is not behind its own near end, nor behind what is `before`."""
    row, column, found, inside = project(points, inverse(camera.world_from_cam).numpy(), camera)
    cell, found = row[inside] * camera.width + column[inside], found[inside]
    nearest = np.full(camera.height * camera.width, np.inf)
    np.minimum.at(nearest, cell, found)
    # a cell's row of a far road spans a tenth of its depth: the nearest of its points would be too near by half of that
    same = found <= HIDING * nearest[cell]
    count, inverses = (np.bincount(cell[same], w, len(nearest)) for w in (None, 1 / found[same]))
    depth = np.where(count > 0, count / np.maximum(inverses, 1e-9), np.inf).reshape(camera.height, camera.width)

    around = ndimage.minimum_filter(depth, AROUND)
    rows, columns = AROUND[0] // 2, AROUND[1]
    no_lower = ndimage.minimum_filter(depth, (rows + 1, columns), origin=(rows // 2, 0))
    steepest = rows / (stands * camera.lens.focal()[1])  # a plane's inverse depth falls by as much with every row
    may_be_road = (world_directions(camera)[..., 2] < 0).numpy() & (1 / around - 1 / depth < steepest)
    hidden = (depth > HIDING * np.where(may_be_road, no_lower, around)) | (depth > before)
    return np.where(hidden | np.isinf(depth), np.nan, depth)


def by_pictures(plate: Plate, depth: np.ndarray, camera: Camera) -> torch.Tensor:
    """A plate's depth `[h, w]`, NaN where it is not believed, on the grid of its `camera`."""
    grid = grid_of(camera)
    rays = camera_rays(grid).double().numpy()
    with np.errstate(invalid="ignore", divide="ignore"):
        at = rays[..., :2] / rays[..., 2:] * plate.focal + plate.centre
        # the plate's is z; the lens may mean the distance
        h, w = depth.shape
        inside = (rays[..., 2] > 0) & (at > 0).all(-1) & (at[..., 0] < w) & (at[..., 1] < h)
        column, row = np.where(inside[..., None], at, 0).astype(np.int64).transpose(2, 0, 1)
        return as_known(np.where(inside, depth[row, column] / rays[..., 2], np.nan))


def as_known(depth: np.ndarray) -> torch.Tensor:
    """Depth as it is kept: NaN where it is not finite."""
    return torch.from_numpy(np.where(np.isfinite(depth), depth, np.nan)).half()


def mistake(depth: torch.Tensor, alpha: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
    """What rendered depth `[H, W]` costs `[M]` that is not as each of M measured it, `[M, h, w]`: mean over what is known and drawn (the
    logarithm of Turkulainen et al. 2024, "DN-Splatter", of relative errors), 0 for none, 0.7 at `SLACK`."""
    # unlike indexing, whose gradients several threads add up in any order where a picture is smaller than the grid
    shown, solid = F.interpolate(torch.stack([depth, alpha.detach()])[None], measured.shape[1:], mode="nearest-exact")[0]
    known = measured.isfinite() & ((solid > 0.5) & shown.isfinite())
    # by infinity where nobody knows: what is left out has a gradient of 0, which by NaN would be none
    off = (torch.where(known, shown / torch.where(known, measured.float(), torch.inf), 1.0) - 1).abs()
    return torch.log1p(off / SLACK).sum((1, 2)) / known.sum((1, 2)).clamp_min(1)
