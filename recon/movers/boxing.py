"""A box over time around what lidar saw of an object: it faces where it goes, and what is nearest to the lidar is its skin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from recon.ground import above_ground
from recon.log import Track
from recon.movers.following import Cluster
from scenes.ground import Ground
from scenes.poses import pose_from

WENT = 2.0
"""Metres that an object must go for it to be believed."""

LEAST, LEAST_HIGH, WIDEST = 0.4, 1.1, 3.2
"""Metres that an object must be long or wide, and high; and that it may be wide: what is wider was several."""

CHORDS = 6.0, 3.0, 1.5
"""Metres before and after on an object's way between which it faces, first and then: at first, shorter ones tell how the points on it
come and go as the lidar passes."""

OFF, PUSH = 0.15, 3.0
"""Metres by which what is seen of a box is off, and metres a second squared by which things speed up, brake and turn."""

MOST_SEEN = 0.75
"""Quantile of what was seen of a length over time that is taken for it: the largest is a neighbour's."""

CAR, CAR_WIDE, CAR_LONG = (4.3, 1.8), (1.3, 2.4), (2.6, 6.0)
"""Length and width of a car of which only the other is seen, and between what a width and a length is a car's."""


def boxed(clusters: Sequence[Cluster], ground: Ground, stamps_us: np.ndarray) -> Track | None:
    """The box of clusters in time order, at those of `stamps_us` that lie within their time; None where they do not move as one thing."""
    times = np.array([c.time_us for c in clusters]) / 1e6
    middles = np.stack([c.middle() for c in clusters])
    middles = smoothed(times, middles, times)
    for chord in CHORDS:
        heading = headings(middles, chord)
        size, placed = _fitted(clusters, heading, middles)
        middles = smoothed(times, placed, times)
    stamps = stamps_us[(stamps_us >= clusters[0].time_us) & (stamps_us <= clusters[-1].time_us)]
    path = smoothed(times, placed, stamps / 1e6)
    turned = np.interp(stamps / 1e6, times, np.unwrap(headings(middles, CHORDS[-1])))
    base = np.column_stack([path, ground.height(torch.from_numpy(path)).numpy()])
    tops = [np.quantile(above_ground(c.xyz, ground), 0.98) for c in clusters]
    size = np.array([*size, np.quantile(tops, MOST_SEEN)])
    went = np.linalg.norm(path - path.mean(0), axis=1).max() > WENT / 2
    if not went or size[:2].max() < LEAST or size[2] < LEAST_HIGH or size[1] > WIDEST:
        return None
    zero = np.zeros(len(turned))
    poses = pose_from(np.stack([np.cos(turned / 2), zero, zero, np.sin(turned / 2)], 1), base)
    return Track("", label(size), True, size, stamps, poses, np.full(len(stamps), -1), (f"found at {base[0].round(1).tolist()}",))


def label(size: np.ndarray) -> str:
    """A class by length, width and height."""
    if size[0] < 1.3 and size[1] < 1.3:
        return "pedestrian"
    if size[0] < 2.4 and size[1] < 1.3:
        return "cyclist"
    return "car" if size[0] < 6 else "truck"


def smoothed(
    times: np.ndarray,
    places: np.ndarray,
    at: np.ndarray,
    told: np.ndarray | None = None,
    speeds: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Places `[K, 2]` at rising seconds `at` of places `[T, 2]` seen at rising `times`, by least squares with `PUSH`; what is farther off
    than three times what is likely pulls no harder (Huber 1964). told: how surely each place is known, inverse covariances `[T, 2, 2]`;
    `OFF` every way where None. speeds: how fast they went, too, `[T, 2]` in m/s, and how far off each of both is, `[2]`."""
    knots = np.union1d(times, at)
    seen = np.searchsorted(knots, times)
    bend = bends(knots) / PUSH
    told = np.broadcast_to(np.eye(2) / OFF**2, (len(times), 2, 2)) if told is None else told
    calm = (bend.T @ bend + 1e-9 * np.eye(len(knots)))[:, :, None, None] * np.eye(2)
    drawn = np.zeros((len(knots), 2))
    if speeds is not None:
        ends = np.stack([np.maximum(seen - 1, 0), np.minimum(seen + 1, len(knots) - 1)])
        pace = np.zeros((len(times), len(knots)))
        np.put_along_axis(pace, ends.T, np.array([-1, 1]) / (knots[ends[1]] - knots[ends[0]])[:, None], axis=1)
        calm += (pace.T @ pace)[:, :, None, None] * np.diag(1 / speeds[1] ** 2)
        drawn += pace.T @ speeds[0] / speeds[1] ** 2
    weight = np.ones(len(times))
    for _ in range(4):
        matrix, right = calm.copy(), drawn.copy()
        np.add.at(matrix, (seen, seen), weight[:, None, None] * told)
        np.add.at(right, seen, weight[:, None] * np.einsum("tij,tj->ti", told, places))
        flat = matrix.swapaxes(1, 2).reshape(right.size, right.size)
        found = np.linalg.solve(flat, right.ravel()).reshape(right.shape)
        off = found[seen] - places
        weight = np.minimum(1, 3 / np.sqrt(np.maximum(np.einsum("ti,tij,tj->t", off, told, off), 1e-9)))
    return found[np.searchsorted(knots, at)]


def bends(seconds: np.ndarray) -> np.ndarray:
    """What makes of places at rising seconds `[K]` the forces that bend the way between them, each over the square root of the time that it
    has, `[K - 2, K]`: white noise."""
    bend = np.zeros((max(len(seconds) - 2, 0), len(seconds)))
    for i, (before, after) in enumerate(zip(np.diff(seconds)[:-1], np.diff(seconds)[1:], strict=True)):
        half = (before + after) / 2
        bend[i, i : i + 3] = np.array([1 / before, -1 / before - 1 / after, 1 / after]) / half * np.sqrt(half)
    return bend


def headings(middles: np.ndarray, chord: float) -> np.ndarray:
    """Yaw `[T]` in radians of where it goes: from where it was `chord` metres before, or first, to where it is as far after, or last."""
    far = np.linalg.norm(middles[:, None] - middles[None], axis=2) >= chord
    index = np.arange(len(middles))
    before = np.where(far & (index < index[:, None]), index, 0).max(1)
    after = np.where(far & (index > index[:, None]), index, len(middles) - 1).min(1)
    way = middles[after] - middles[before]
    return np.arctan2(way[:, 1], way[:, 0])


def _fitted(clusters: Sequence[Cluster], heading: np.ndarray, middles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Length and width, and each moment's middle `[T, 2]`: the box's skin lies where the points that are nearest to the lidar are."""
    low, high, towards = (np.zeros((len(clusters), 2)) for _ in range(3))
    axes = np.stack([np.stack([np.cos(heading), np.sin(heading)], 1), np.stack([-np.sin(heading), np.cos(heading)], 1)], 1)
    for i, (cluster, middle) in enumerate(zip(clusters, middles, strict=True)):
        local = (cluster.xyz[:, :2] - middle) @ axes[i].T
        low[i], high[i] = local.min(0), local.max(0)
        towards[i] = axes[i] @ (cluster.eye[:2] - middle)
    size = np.quantile(high - low, MOST_SEEN, axis=0)
    if CAR_WIDE[0] < size[1] < CAR_WIDE[1]:
        size[0] = max(size[0], CAR[0])
    elif CAR_LONG[0] < size[0] < CAR_LONG[1]:
        size[1] = max(size[1], CAR[1])
    # the side that faces the lidar is seen; where it looks along a side, both ends are
    skin = np.clip(towards / (size / 2), -1, 1)
    centre = np.where(skin > 0, high - size / 2, low + size / 2) * np.abs(skin) + (1 - np.abs(skin)) * (low + high) / 2
    return size, middles + np.einsum("tkx,tk->tx", axes, centre)
