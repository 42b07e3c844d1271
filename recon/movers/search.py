"""Finds what moves in a drive that nobody annotated: points that others saw through, clustered, and followed from sweep to sweep."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from recon.ground import above_ground, estimate_ground
from recon.log import LidarPoints, Log, Sweep, Track
from recon.movers.boxing import boxed
from recon.movers.following import FEWEST, Cluster, Followed, Patience, follow
from recon.movers.freespace import RangeImage, range_images, tally
from recon.objects.actors import MARGIN, SWEPT_MARGIN, inside
from recon.objects.tracks import named
from recon.readers.recorder import LENGTH, WIDTH, highest_of, size_of
from scenes.ground import Ground
from scenes.poses import inverse
from scenes.trajectory import Trajectory

HEIGHTS = (0.3, 4.5)
"""Metres above the ground that are looked at."""

REACH = 60.0
"""Metres around the body that are looked at."""

MOST, THIN = 15_000, 20_000
"""Points of a sweep that are looked at, and about as many that tell where the ground is."""

THROUGH, OVER = 2, 0.3
"""Others that must have seen through a point, and times those that saw something there, for it to have moved: a car before a red light
stands where it is for most of them."""

NEAR = 0.45, 2.0, 1.4
"""Metres between points of one object: so many, and so many cells of the range image at that distance, up to so many."""

SHARE = 0.4
"""Part of all points in and around an object's box that must have moved: leaves and edges seem to, in the midst of what stands."""

OWN = 4.2, 1.2
"""Metres ahead or behind and aside of the body within which what goes is the recording car's own bonnet; of a robot as much less, and what
moves is looked for as much lower (`recon.readers.recorder.size_of`)."""

TILE = 0.1
"""Metres: beside the lidar thousands of points lie within one, and one of each tile of this side stands for all in it."""


def with_movers(log: Log, sweeps: Sequence[Sweep], report: Callable[[], None] = lambda: None) -> Log:
    """The log with what moves in `sweeps` as its tracks, at the stamps of all its sweeps. `report` is called after each."""
    read = _read(sweeps)
    some = np.concatenate([p.xyz[:: max(1, len(p.xyz) // THIN)] for p in read.values()])
    ground = estimate_ground(some, log.ego.within((min(read), max(read))))
    images = range_images(log, read.items())
    followed: list[Followed] = []
    patience = Patience.of(list(read))
    asked: dict[int, np.ndarray] = {}
    part = _size(log, read)
    for time, points in read.items():
        asked[time] = candidates(log, time, points, ground, part)
        eye = log.ego.near(time)[:3, 3].numpy()
        follow(followed, clusters(time, asked[time], images, eye), time, eye, asked[time], patience)
        report()
    stamps = np.unique([s.time_us for s in log.sweeps])
    made = [(f, boxed(f.clusters, ground, stamps)) for f in followed if f.believed and not _own(f, log.ego, part)]
    tracks = [(f, t) for f, t in made if t is not None and _moved(f.clusters, t, asked) >= SHARE]
    return replace(log, tracks=named(_apart(tracks), log.ego))


def _read(sweeps: Sequence[Sweep]) -> dict[int, LidarPoints]:
    """The points by time, in its order; sweeps of several lidars at one moment are one."""
    read: dict[int, list[LidarPoints]] = {}
    for sweep in sorted(sweeps, key=lambda s: s.time_us):
        read.setdefault(sweep.time_us, []).append(sweep.read())
    fields = ("xyz", "times_us", "sensor")
    return {time: LidarPoints(*(np.concatenate([getattr(p, f) for p in parts]) for f in fields)) for time, parts in read.items()}


def _size(log: Log, read: Mapping[int, LidarPoints]) -> float:
    """What part of a car's size the recording one has."""
    top = highest_of(log)
    return float(np.median([size_of(_in_body(log, time, points.xyz), top) for time, points in read.items()]))


def _in_body(log: Log, time_us: int, xyz: np.ndarray) -> np.ndarray:
    pose = log.ego.near(time_us).numpy()
    return (xyz - pose[:3, 3]) @ pose[:3, :3]


def _own(one: Followed, ego: Trajectory, part: float) -> bool:
    """Whether what was followed is the recording car itself, most of the time."""
    local = _seen_from(torch.stack([ego.near(c.time_us) for c in one.clusters]), np.array(one.places))
    return bool((np.median(np.abs(local), axis=0) < part * np.array(OWN)).all())


def _seen_from(poses: torch.Tensor, places: np.ndarray) -> np.ndarray:
    """Places `[N, 2]` of the world in the plane of as many poses."""
    back = inverse(poses).numpy()
    return np.einsum("nij,nj->ni", back[:, :2, :2], places) + back[:, :2, 3]


def _moved(clusters: list[Cluster], track: Track, asked: dict[int, np.ndarray]) -> float:
    """Part of the points in an object's box that moved, over all sweeps that saw it."""
    moved = there = 0
    places = {int(t): i for i, t in enumerate(track.times_us)}
    for cluster in (c for c in clusters if c.moved):
        back = inverse(track.world_from_box[places[cluster.time_us]]).numpy()
        own, every = (x @ back[:3, :3].T + back[:3, 3] for x in (cluster.xyz, asked[cluster.time_us]))
        moved += inside(own, track.size, SWEPT_MARGIN).sum()
        there += inside(every, track.size, SWEPT_MARGIN).sum()
    return moved / max(there, 1)


def _apart(made: list[tuple[Followed, Track]]) -> list[Track]:
    """The tracks without those that are parts of a longer one most of the time: a bonnet that was followed by itself."""
    kept: list[Track] = []
    for one, track in sorted(made, key=lambda m: (-len(m[1].times_us), -m[1].size.prod())):
        if not any(_within(one, other) > 0.5 for other in kept):
            kept.append(track)
    return kept


def _within(one: Followed, track: Track) -> float:
    """Part of an object's time in which its middle lies in the box of a track."""
    times = np.array([c.time_us for c in one.clusters])
    _, mine, its = np.intersect1d(times, track.times_us, return_indices=True)
    local = _seen_from(track.world_from_box[its], np.array(one.places)[mine])
    return float((np.abs(local) < track.size[:2] / 2 + MARGIN).all(1).sum()) / len(times)


def candidates(log: Log, time_us: int, points: LidarPoints, ground: Ground, part: float) -> np.ndarray:
    """The points `[N, 3]` of a sweep that may move: over the ground, within reach, and not the recording car itself, which has that part of
    a car's size."""
    xyz = points.xyz
    local = _in_body(log, time_us, xyz)
    height = above_ground(xyz, ground)
    own = (np.abs(local[:, 0]) < part * LENGTH / 2) & (np.abs(local[:, 1]) < part * WIDTH / 2)
    away = np.linalg.norm(local[:, :2], axis=1)
    kept = xyz[(height > part * HEIGHTS[0]) & (height < HEIGHTS[1]) & (away < REACH) & ~own]
    return kept[:: max(1, -(-len(kept) // MOST))]


def clusters(time_us: int, xyz: np.ndarray, images: list[tuple[int, RangeImage]], eye: np.ndarray) -> list[Cluster]:
    """What of a sweep's points moved, one cluster an object."""
    through, there = tally(xyz, time_us, images)
    moved = xyz[(through >= THROUGH) & (through >= OVER * there)]
    if len(moved) < FEWEST:
        return []
    _, first, tile = np.unique(np.floor(moved[:, :2] / TILE), axis=0, return_index=True, return_inverse=True)
    places = moved[first, :2]
    spacing = np.radians(min(image.cell for _, image in images)) * np.linalg.norm(places - eye[:2], axis=1)
    near = np.clip(NEAR[0] + NEAR[1] * spacing, None, NEAR[2])
    pairs = cKDTree(places).query_pairs(NEAR[2], output_type="ndarray")
    apart = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    pairs = pairs[apart < near[pairs].min(1)]
    joined = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(places), len(places)))
    object_of = connected_components(joined, directed=False)[1][tile.ravel()]
    order = np.argsort(object_of, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(object_of[order])) + 1)
    return [Cluster(moved[p], time_us, eye) for p in parts if len(p) >= FEWEST]
