"""Everything a fit starts from, made from a log and its frames: seeds of background and actors, sky, exposures, trajectories."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from scipy.spatial import cKDTree

from recon.actors import box_skin, split_points
from recon.fit.model import Splats, draw
from recon.fit.reach import reach_at, reach_of, spanned
from recon.fit.swept import Swept
from recon.frames import Frames
from recon.ground import estimate_ground, shown_ground
from recon.log import Log, SparsePoints, Sweep, Track
from recon.movers.traffic import traffic
from recon.seeds.aside import seen_from_aside
from recon.seeds.beyond import beyond_lidar
from recon.seeds.carpet import carpet
from recon.seeds.dense import agreeing, cloud_from_pictures, points_of
from recon.seeds.fill import Search
from recon.seeds.measured import Measured, by_lidar, by_lidar_of_movers
from recon.seeds.points import Cloud, colours, fewer, first_exposures, merged_colours, splats_from, thin
from recon.seeds.shade import shade
from recon.seeds.standing import by_all_sweeps
from recon.skies import SkyPicture, like_sky
from recon.tracks import LIMBED
from recon.view import View
from scenes.camera import RigCamera
from scenes.gaussians import Gaussians, Placed
from scenes.ground import Ground
from scenes.poses import interpolate, inverse
from scenes.trajectory import Trajectory

SEED_PART = 0.3
"""Of the splat budget that lidar may take: the rest grows where pictures ask for it. With half of it five cameras of drive 002 lose 0.2 dB
in front, and more is open aside."""

BEYOND_PART = 0.06
"""Of the splat budget that what pictures show beyond lidar may take besides: twice as much brought KITTI 0009 nothing."""

ACTORS_PART, MOST_OF_ONE = 0.09, 3000
"""Of the splat budget that all movers' lidar points may take, and how many of one: traffic must not leave the street without."""

ASIDE_PART = 0.03
"""Of the splat budget that what lidar alone saw, but cameras beside the path would, may take besides."""

CARPET_PART = 0.15
"""Of the splat budget that the ground may take that nobody saw: of a way of some hundred metres, 30 cm apart, it takes that much."""

FILLED_PART = 0.9
"""Of the splat budget that all of these may take at most, with the ground that nobody saw and what fills holes."""

LACKING = 1.5
"""Usual steps that one from a picture of the first camera to its next takes where it lacks some between."""

SKY_HEIGHT = 256

WIDEST_SEED = 0.012
"""Of its reach: a seed's width at most, 12 pixels."""


@dataclass
class Start:
    """The start of a fit: splats of background and actors, the tracks they belong to, sky, exposures, the body's path, ground and what is
    known of it, rig, the depths that were measured in views, where nothing stands, the views' gains, and what of them is sky."""

    splats: Splats
    tracks: list[Track]
    sky: torch.Tensor
    exposures: torch.Tensor
    ego: Trajectory
    ground: Ground
    ground_shown: torch.Tensor
    rig: dict[str, RigCamera]
    measured: tuple[Measured, ...]
    swept: Swept
    gains: tuple[torch.Tensor | None, ...]
    skies: tuple[torch.Tensor, ...]


def prepare(
    log: Log,
    frames: Frames,
    span_us: tuple[int, int],
    budget: int,
    sh_count: int,
    report: Callable[[str], None],
    sparse: SparsePoints | None = None,
    exposures: torch.Tensor | None = None,
) -> Start:
    """Read the sweeps of the span and make the start of a fit; where it has none, of the points that pictures show, `sparse`.

    exposures: of the cameras, affine `[C, 3, 4]`, where they are known. ValueError where a drive has no lidar point in view.
    """
    rig = log.rig(dict(zip(frames.names, frames.sizes, strict=True)))
    ego, driven = body_path(log, frames, rig), log.ego.within(span_us)
    sweeps = log.sweeps_within(span_us)
    movers = [t for t in log.tracks if t.moving and t.times_us[-1] >= span_us[0] and t.times_us[0] <= span_us[1]]
    told = None if exposures is None else exposures.diagonal(dim1=1, dim2=2).double().numpy()
    if sparse is not None:
        agreed = agreeing(log, frames, sparse, estimate_ground(sparse.xyz, driven))
        if not log.tracks:
            movers = list(traffic(log, frames, estimate_ground(points_of(agreed), driven)))
    report("sorting lidar points")
    split = split_points(log, sweeps, movers)
    taken = _began(sweeps, split.static_sweep)
    report("colouring points")
    if sparse is not None:
        gains = np.ones((len(frames.names), 3)) if told is None else told
        cloud, *measured = cloud_from_pictures(log, frames, sparse, agreed, movers, gains)
        ground = estimate_ground(cloud.xyz, driven)
        beyond = unseen = Cloud.cat([])
    else:
        ground = estimate_ground(split.static, driven)
        seen = colours(log, frames, split.static, taken, list(split.tracks))
        gains = first_exposures(seen) if told is None else told
        rgb = merged_colours(seen, gains)
        known = np.isfinite(rgb[:, 0])
        if not known.any():
            raise ValueError(f"{log.path} has no lidar point that the cameras {', '.join(frames.names)} see; check the span and the poses")
        cloud = Cloud(split.static[known], rgb[known])
        unseen = seen_from_aside(log, frames, split.static[~known], cloud, ground)
        report("measuring depth")
        struck = by_lidar(log, frames, sweeps, split, movers)
        beyond, by_pictures = beyond_lidar(log, frames, struck, ground, movers, gains)
        everything = struck.completed(by_lidar_of_movers(log, frames, sweeps, split))
        measured = [everything, by_all_sweeps(log, frames, split, movers).without(by_pictures), by_pictures]
    path = cKDTree(ego.world_from_body[:, :3, 3].numpy())
    cloud, sides = _thinned(path, (cloud, int(budget * SEED_PART)), (beyond, int(budget * BEYOND_PART)), (unseen, int(budget * ASIDE_PART)))
    background = splats_from(cloud, sides, sh_count, WIDEST_SEED * reach_at(cloud.xyz, ego, rig.values()))
    background = Gaussians.cat([background, carpet(cloud, ground, ego, sh_count, int(budget * CARPET_PART))])

    groups, reaches, tracks = [], [], []
    most = even_limit([len(points) for points, _ in split.actors.values()], int(budget * ACTORS_PART))
    for track in split.tracks:
        points, index = split.actors.get(track.name, (np.zeros((0, 3)), np.zeros(0, np.int64)))
        made = _actor(log, frames, track, points, _began(sweeps, index), gains, sh_count, min(most, MOST_OF_ONE))
        if len(made):
            below = shade(track, ground, sh_count) if track.label not in LIMBED else Gaussians.empty(sh_count)
            groups.append(Gaussians.cat([made, below]))
            tracks.append(track)
            middle = track.world_from_box[:, :3, 3].numpy()
            near = max(2.0, float(path.query(middle)[0].min()) - float(track.size[0]) / 2)
            reaches.append(spanned(rig.values()) * near)

    standing = [t for t in log.tracks if not t.moving]
    swept = Swept.by([*split.tracks, *standing], span_us, ground, split.static, taken)

    report("filling what lidar missed")
    filled, sky = _fill(log, frames, background, groups, tracks, gains, sh_count, ground)
    if exposures is None:
        exposures = torch.zeros(len(frames.names), 3, 4)
        exposures[:, :, :3] = torch.diag_embed(torch.from_numpy(gains).float())
    share = FILLED_PART * budget / max(1, sum(map(len, (filled, *groups))))
    filled, *groups = (fewer(group, max(1, share * len(group))) for group in (filled, *groups))
    of_groups = [torch.full((len(group),), reach) for group, reach in zip(groups, reaches, strict=True)]
    splats = Splats.of([filled, *groups], [reach_of(filled, ego, rig.values()), *of_groups])
    of_views = tuple(v.gain for v in frames.views), tuple(v.sky for v in frames.views)
    ground_shown = shown_ground(split.static, ground)  # by lidar alone: points from pictures are as far off as what it is to mend
    return Start(splats, tracks, sky, exposures, ego, ground, ground_shown, rig, tuple(measured), swept, *of_views)


def _thinned(path: cKDTree, *parts: tuple[Cloud, int]) -> tuple[Cloud, np.ndarray]:
    """Of each cloud about as many points as it may have, together, and their voxels' sides (`thin`)."""
    few = [thin(cloud, path.query(cloud.xyz)[0], most) for cloud, most in parts if len(cloud.xyz)]
    return Cloud.cat([cloud for cloud, _ in few]), np.concatenate([sides for _, sides in few])


def body_path(log: Log, frames: Frames, rig: dict[str, RigCamera]) -> Trajectory:
    """The body at the first camera's moments, from its recorded poses, one step longer at either end.

    Camera poses are recorded closer to the pictures than the lidar's are. Where the camera lacks some, the body goes as the log has it, and
    no shortcut: other cameras took theirs there.
    """
    name = frames.names[0]
    camera, back = log.camera(name), inverse(rig[name].body_from_cam)
    views = [v for v in frames.views if v.camera == 0]
    times = [v.time_us for v in views]
    poses = [camera.world_from_cam[v.index] @ back for v in views]
    times, poses = _without_gaps(log.ego, times, poses)
    if len(times) > 1:
        times = [2 * times[0] - times[1], *times, 2 * times[-1] - times[-2]]
        poses = [interpolate(poses[0], poses[1], -1.0), *poses, interpolate(poses[-2], poses[-1], 2.0)]
    return Trajectory(torch.tensor(times), torch.stack(poses))


def _without_gaps(ego: Trajectory, times: list[int], poses: list[torch.Tensor]) -> tuple[list[int], list[torch.Tensor]]:
    """Times and a body's poses with those of its path `ego`, where it has any, in steps of which a usual one is less than `LACKING`; moved
    as they are before and after the step."""
    if len(times) < 3:
        return times, poses
    usual = float(np.median(np.diff(times)))
    off = inverse(ego.near_each(torch.tensor(times))) @ torch.stack(poses)
    whole_times, whole_poses = times[:1], poses[:1]
    for i, (first, last) in enumerate(pairwise(times)):
        between = np.linspace(first, last, round((last - first) / usual) + 1)[1:-1].round().astype(np.int64)
        if last - first > LACKING * usual and ((ego.times_us > first) & (ego.times_us < last)).any():
            moved = [interpolate(off[i], off[i + 1], (t - first) / (last - first)) for t in between.tolist()]
            whole_times += between.tolist()
            whole_poses += list(ego.near_each(torch.from_numpy(between)) @ torch.stack(moved))
        whole_times.append(last)
        whole_poses.append(poses[i + 1])
    return whole_times, whole_poses


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
    if len(points) < 100:
        skin = box_skin(track.size, max(0.15, float(track.size[:2].min()) / 6))
        moment = _nearest(log, track, frames.of(0))
        points, taken_us = np.concatenate([points, skin]), np.concatenate([taken_us, np.full(len(skin), moment)])
    times = sorted({v.time_us for v in frames.training() if trajectory.covers(v.time_us)})
    poses = dict(zip(times, trajectory.at_each(torch.tensor(times, dtype=torch.int64)), strict=True))
    seen = colours(log, frames, points, taken_us, [], lambda view: poses.get(view.time_us))
    rgb = merged_colours(seen, gains)
    known = np.isfinite(rgb[:, 0])
    if not known.any():
        return Gaussians.empty(sh_count)
    cloud, sides = thin(Cloud(points[known], rgb[known]), np.ones(known.sum()), most)
    return splats_from(cloud, sides, sh_count, 0.15)


def _began(sweeps: Sequence[Sweep], index: np.ndarray) -> np.ndarray:
    """When the sweeps with indices `[N]` were taken, int64 us `[N]`: frames of cameras have other numbers, and others each."""
    times = np.zeros(max((s.index for s in sweeps), default=0) + 1, dtype=np.int64)
    times[[s.index for s in sweeps]] = [s.time_us for s in sweeps]
    return times[index]


def _nearest(log: Log, track: Track, views: list[View]) -> int:
    """Time of the view during which a box is nearest to the body, of those in whose time there is one; the first where there is none."""
    trajectory = track.trajectory()
    there = [v for v in views if trajectory.covers(v.time_us)]
    if not there:
        return views[0].time_us if views else 0
    times = torch.tensor([v.time_us for v in there])
    apart = (trajectory.at_each(times) - log.ego.at_each(times))[:, :3, 3].norm(dim=1)
    return there[int(apart.argmin())].time_us


def _usual(frames: Frames, gains: np.ndarray) -> np.ndarray:
    """The colour `[3]` that training pictures have in the median, in the reference exposure: what stands in for a sky that none of them
    surely shows, at night or by a camera that looks down, is seen beyond their borders from aside, and must not shine there."""
    some = [v.evenly()[::4, ::4].reshape(-1, 3) / gains[v.camera] for v in frames.training()]
    return np.median(np.concatenate(some), axis=0)


def _fill(log: Log, frames: Frames, background: Gaussians, actors: list[Gaussians], tracks: list[Track], gains, sh_count, ground: Ground):
    """Background with splats added where views show neither splats nor sky, and the sky `[H, 2H, 3]`."""
    picture = SkyPicture(SKY_HEIGHT, _usual(frames, gains))
    world = torch.eye(4, dtype=torch.float64)
    for c in range(len(frames.names)):
        views = frames.of(c)
        search = Search(views, [frames.camera(log, v) for v in views], gains[c], ground, tracks)
        for view, camera, hidden in search:
            placed = [Placed(background, world)]
            for track, splats in zip(tracks, actors, strict=True):
                trajectory = track.trajectory()
                if trajectory.covers(view.time_us):
                    placed.append(Placed(splats, trajectory.at(view.time_us)))
            alpha, depth = (t.numpy() for t in draw(placed, camera, "alpha", "depth"))
            covered = (alpha > 0.3) | hidden
            sky = frames.sky_of(view) & ~covered
            # of frames that were exposed one by one the darkest show it best: in others it is clipped
            weight = 1.0 if view.gain is None else float(view.gain.mean()) ** -4
            picture.add(view.evenly(), sky, camera, gains[c], weight)
            sky = like_sky(view.image.numpy(), sky) & ~covered
            background = Gaussians.cat([background, search.found(view, camera, hidden, alpha, depth, sky, sh_count)])
    return background, picture.picture()
