"""Everything a fit starts from, made from a log and its frames: seeds of background and actors, sky, exposures, trajectories."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from recon.body_path import body_path
from recon.fit.model import Splats, draw
from recon.fit.openings import ASIDE, aside_of
from recon.fit.reach import held_back, nearest_of, reach_at, reach_of, spanned
from recon.fit.swept import Swept
from recon.ground import STRAY_IN_PICTURES, estimate_ground, shown_ground
from recon.log import Log, SparsePoints, Sweep, Track
from recon.movers.traffic import traffic
from recon.objects.actors import Split, split_points
from recon.seeds.actors import actor_seeds, times_of
from recon.seeds.aside import seen_from_aside
from recon.seeds.beyond import beyond_lidar
from recon.seeds.carpet import carpet
from recon.seeds.dense import Depths, agreeing, cloud_from_pictures, points_of
from recon.seeds.fill import Search
from recon.seeds.fineness import seen_from
from recon.seeds.measured import Measured, by_lidar, by_lidar_of_movers
from recon.seeds.points import Cloud, colours, fewer, first_exposures, merged_colours, splats_from, thin
from recon.seeds.road import road_by_pictures
from recon.seeds.standing import by_all_sweeps
from recon.views.frames import Frames
from recon.views.skies import SkyPicture, like_sky
from scenes.camera import RigCamera
from scenes.gaussians import Gaussians, Placed
from scenes.ground import Ground
from scenes.trajectory import Trajectory

SEED_PART = 0.3
"""Part of the splat budget for lidar points: the rest grows where pictures ask for it. With half of this, five cameras of drive 002 lose
0.2 dB in front, and there are more gaps aside."""

BEYOND_PART = 0.06
"""Part of the budget for what only pictures reach, beyond lidar: twice as much gained KITTI 0009 nothing."""

ASIDE_PART = 0.03
"""Part of the budget for lidar points that no recorded picture shows, but cameras beside the path would see."""

CARPET_PART = 0.15
"""Part of the budget for ground that neither lidar nor pictures saw: enough for some hundred metres of road at a spacing of 30 cm."""

FILLED_PART = 0.9
"""Part of the budget that all seeds together may take, with that ground and what fills holes."""

SKY_HEIGHT = 256

WIDEST_SEED = 0.012
"""Largest width of a seed, as a part of its reach: 12 pixels."""


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


@dataclass
class _Street:
    """What lidar or pictures show of what stands still: points in colours, those `beyond` lidar's reach and those that only cameras beside
    the path would see (`aside`), the ground, the cameras' `gains` `[C, 3]`, and the depths measured in views."""

    points: Cloud
    beyond: Cloud
    aside: Cloud
    ground: Ground
    gains: np.ndarray
    measured: list[Measured]


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

    budget: splats that the fit may have; sh_count: spherical harmonics of each. exposures: of the cameras, affine `[C, 3, 4]`, where they
    are known. `report` is told what is being done. ValueError where a drive has no lidar point in view.
    """
    rig = log.rig(dict(zip(frames.names, frames.sizes, strict=True)))
    ego, driven = body_path(log, frames, rig), log.ego.within(span_us)
    sweeps = log.sweeps_within(span_us)
    movers = [t for t in log.tracks if t.moving and t.times_us[-1] >= span_us[0] and t.times_us[0] <= span_us[1]]
    known = None if exposures is None else exposures.diagonal(dim1=1, dim2=2).double().numpy()
    if sparse is not None:
        agreed, lies = _seen_by_pictures(log, frames, sparse, driven, span_us)
        if not log.tracks:
            movers = list(traffic(log, frames, estimate_ground(np.concatenate([points_of(agreed), lies]), driven)))
    report("sorting lidar points")
    split = split_points(log, sweeps, movers)
    taken_us = times_of(sweeps, split.static_sweep)
    report("colouring points")
    if sparse is not None:
        gains = np.ones((len(frames.names), 3)) if known is None else known
        points, *measured = cloud_from_pictures(log, frames, sparse, agreed, movers, gains)
        shown = np.concatenate([points.xyz, lies])
        street = _Street(points, Cloud.cat([]), Cloud.cat([]), estimate_ground(shown, driven), gains, measured)
    else:
        street = _lidar_street(log, frames, sweeps, split, movers, driven, taken_us, known, report)
    ground, gains = street.ground, street.gains
    shares = (street.points, SEED_PART), (street.beyond, BEYOND_PART), (street.aside, ASIDE_PART)
    nearest = nearest_of(street.measured)
    few = [thin(p, seen_from(p.xyz, ground, ego, rig.values(), nearest), int(budget * part)) for p, part in shares if len(p.xyz)]
    cloud, sides = Cloud.cat([p for p, _ in few]), np.concatenate([sides for _, sides in few])
    background = splats_from(cloud, sides, sh_count, WIDEST_SEED * reach_at(cloud.xyz, ego, rig.values(), nearest))
    shown = np.concatenate([p.xyz for p, _ in shares])
    background = Gaussians.cat([background, carpet(shown, cloud, ground, ego, sh_count, int(budget * CARPET_PART))])

    path = cKDTree(ego.world_from_body[:, :3, 3].numpy())
    groups, reaches, tracks = [], [], []
    for track, seeds in actor_seeds(log, frames, sweeps, split, ground, gains, sh_count, budget):
        groups.append(seeds)
        tracks.append(track)
        middle = track.world_from_box[:, :3, 3].numpy()
        near = max(2.0, float(path.query(middle)[0].min()) - float(track.size[0]) / 2)
        reaches.append(spanned(rig.values()) * near)

    standing = [t for t in log.tracks if not t.moving]
    swept = Swept.by([*split.tracks, *standing], span_us, ground, split.static, taken_us)

    report("filling what lidar missed")
    filled, sky = _fill(log, frames, background, groups, tracks, gains, sh_count, ground)
    if exposures is None:
        exposures = torch.zeros(len(frames.names), 3, 4)
        exposures[:, :, :3] = torch.diag_embed(torch.from_numpy(gains).float())
    share = FILLED_PART * budget / max(1, sum(map(len, (filled, *groups))))
    filled, *groups = (fewer(group, max(1, share * len(group))) for group in (filled, *groups))
    of_groups = [torch.full((len(group),), reach) for group, reach in zip(groups, reaches, strict=True)]
    reach = held_back(reach_of(filled, ego, rig.values(), nearest), filled, street.aside.xyz)
    splats = Splats.of([filled, *groups], [reach, *of_groups])
    of_views = tuple(v.gain for v in frames.views), tuple(v.sky for v in frames.views)
    ground_shown = shown_ground(split.static, ground) if sparse is None else shown_ground(shown, ground, STRAY_IN_PICTURES)
    return Start(splats, tracks, sky, exposures, ego, ground, ground_shown, rig, tuple(street.measured), swept, *of_views)


def _seen_by_pictures(
    log: Log, frames: Frames, sparse: SparsePoints, driven: Trajectory, span_us: tuple[int, int]
) -> tuple[list[Depths], np.ndarray]:
    """Depths on which pictures agree, and points `[N, 3]` of the road where it takes more than these to tell it."""
    agreed = agreeing(log, frames, sparse, estimate_ground(sparse.xyz, driven))
    points = points_of(agreed)
    road = road_by_pictures(log, frames.names, driven, span_us, points, estimate_ground(points, driven))
    if road is None:
        return agreed, np.zeros((0, 3))
    lies = road.points()
    ground = estimate_ground(np.concatenate([points, lies]), driven)  # under which nothing is looked for
    return [own.on(road) for own in agreeing(log, frames, sparse, ground)], lies


def _lidar_street(
    log: Log,
    frames: Frames,
    sweeps: Sequence[Sweep],
    split: Split,
    movers: list[Track],
    driven: Trajectory,
    taken_us: np.ndarray,
    known: np.ndarray | None,
    report: Callable[[str], None],
) -> _Street:
    """The street by lidar. driven: the body's path in the span; taken_us: when each static point was measured, `[N]`; known: the cameras'
    gains `[C, 3]`, estimated where None."""
    ground = estimate_ground(split.static, driven)
    seen = colours(log, frames, split.static, taken_us, list(split.tracks))
    gains = first_exposures(seen) if known is None else known
    rgb = merged_colours(seen, gains)
    coloured = np.isfinite(rgb[:, 0])
    if not coloured.any():
        raise ValueError(f"{log.path} has no lidar point that the cameras {', '.join(frames.names)} see; check the span and the poses")
    points = Cloud(split.static[coloured], rgb[coloured])
    report("measuring depth")
    struck = by_lidar(log, frames, sweeps, split, movers)
    aside = seen_from_aside(log, frames, split.static[~coloured], points, ground, aside_of([struck]) / ASIDE)
    beyond, by_pictures = beyond_lidar(log, frames, struck, ground, movers, gains)
    everything = struck.completed(by_lidar_of_movers(log, frames, sweeps, split))
    measured = [everything, by_all_sweeps(log, frames, split, movers).without(by_pictures), by_pictures]
    return _Street(points, beyond, aside, ground, gains, measured)


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
