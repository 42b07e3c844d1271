"""Initial splats of movers: their own lidar points, or where there are few, the skin of their boxes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from recon.log import Log, Sweep, Track
from recon.objects.actors import Split, box_skin
from recon.objects.tracks import LIMBED
from recon.seeds.points import Cloud, colours, merged_colours, splats_from, thin
from recon.seeds.shade import shade
from recon.views.frames import Frames
from recon.views.project import project
from scenes.gaussians import Gaussians
from scenes.ground import Ground
from scenes.poses import inverse

ACTORS_PART, MOST_OF_ONE = 0.09, 3000
"""Part of the splat budget that all movers' lidar points may take, and the most of one mover: traffic must leave the street its splats."""

NEARLY = 0.9
"""Part of the most points of a box's skin that a picture shows, from which on it shows nearly as much."""


def actor_seeds(
    log: Log, frames: Frames, sweeps: Sequence[Sweep], split: Split, ground: Ground, gains: np.ndarray, sh_count: int, budget: int
) -> Iterator[tuple[Track, Gaussians]]:
    """Each mover of `split` that any picture shows, and its splats in its box frame, with its shade below it. gains: of the cameras
    `[C, 3]`; sh_count: spherical harmonics of each splat; budget: splats that the fit may have."""
    most = even_limit([len(points) for points, _ in split.actors.values()], int(budget * ACTORS_PART))
    for track in split.tracks:
        points, index = split.actors.get(track.name, (np.zeros((0, 3)), np.zeros(0, np.int64)))
        made = _actor(log, frames, track, points, times_of(sweeps, index), gains, sh_count, min(most, MOST_OF_ONE))
        if len(made):
            below = shade(track, ground, sh_count) if track.label not in LIMBED else Gaussians.empty(sh_count)
            yield track, Gaussians.cat([made, below])


def even_limit(counts: Sequence[int], total: int) -> int:
    """How many each may have at most, so that all together have no more than `total`: those of few keep theirs."""
    left, limit = total, total
    for i, count in enumerate(rising := sorted(counts)):
        limit = left // (len(rising) - i)
        if count > limit:
            return limit
        left -= count
    return max([limit, *counts])


def _actor(
    log: Log, frames: Frames, track: Track, points: np.ndarray, taken_us: np.ndarray, gains: np.ndarray, sh_count: int, most: int
) -> Gaussians:
    """Seeds of a mover in its box frame, about `most`: its own lidar points, of sweeps at these times `[N]`, and where they are few, the
    skin of its box."""
    trajectory = track.trajectory()
    times = sorted({v.time_us for v in frames.training() if trajectory.covers(v.time_us)})
    poses = dict(zip(times, trajectory.at_each(torch.tensor(times, dtype=torch.int64)), strict=True))
    if len(points) < 100:
        skin = box_skin(track.size, max(0.15, float(track.size[:2].min()) / 6))
        moment = _shown_best(log, frames, poses, skin)
        points, taken_us = np.concatenate([points, skin]), np.concatenate([taken_us, np.full(len(skin), moment)])
    seen = colours(log, frames, points, taken_us, [], lambda view: poses.get(view.time_us))
    rgb = merged_colours(seen, gains)
    known = np.isfinite(rgb[:, 0])
    if not known.any():
        return Gaussians.empty(sh_count)
    cloud, sides = thin(Cloud(points[known], rgb[known]), np.ones(known.sum()), most)
    return splats_from(cloud, sides, sh_count, 0.15)


def _shown_best(log: Log, frames: Frames, poses: dict[int, torch.Tensor], skin: np.ndarray) -> int:
    """Time of the training picture from nearest by of those that show nearly as much of a box's skin, points `[N, 3]` on it, as any does;
    0 where none shows any of it. From nearest by of all it may be beside the camera. poses: of the box at pictures' times."""
    shown = []
    for view in (v for v in frames.training() if v.time_us in poses):
        camera = frames.camera(log, view)
        placed = inverse(camera.world_from_cam) @ poses[view.time_us]
        shown.append((int(project(skin, placed.numpy(), camera)[3].sum()), float(placed[:3, 3].norm()), view.time_us))
    most = max((count for count, *_ in shown), default=0)
    return min(((away, time) for count, away, time in shown if count and count >= NEARLY * most), default=(0.0, 0))[1]


def times_of(sweeps: Sequence[Sweep], index: np.ndarray) -> np.ndarray:
    """Times of the sweeps with indices `[N]`, int64 us `[N]`. Indices are the log's own: neither places in `sweeps` nor numbers of
    frames."""
    times = np.zeros(max((s.index for s in sweeps), default=0) + 1, dtype=np.int64)
    times[[s.index for s in sweeps]] = [s.time_us for s in sweeps]
    return times[index]
