"""Follows what moves from sweep to sweep: clusters of points that moved, and what came of them where they stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

FEWEST = 4
"""Points of an object in a sweep."""

FASTEST = 40.0
"""Metres a second."""

GATE = 1.0, 2.0
"""Metres that an object may be off where its speed takes it, and metres a second more for the time since it was seen."""

LOST = 0.3, 2.0
"""Seconds after which an object that is not seen is given up: one that was seen a few times, and one that was seen often enough."""

SOON = 1.5
"""Steps from one sweep to the next after which the former is not given up yet, however long they take."""

SEEN, SEEN_S = (5, 8), 2.0
"""Sweeps that must show an object for it to be believed: those of so many seconds, at least and at most. Of drive 002's sweeps every fifth,
two a second, shows nine movers so, of which none is made up; with four, two of twelve are in part."""

MOVED = 0.25
"""Part of the sweeps that show an object in which it must have moved."""

ALIKE, PART = 0.4, 0.5
"""Metres within which a point of an object must have one where it stands, and the part of its points that must: what brakes behind or
before the lidar stands where nobody has seen through, and is known by its shape alone."""

LESS = 0.8
"""Part of an object's points that must have moved again for these to be all of it."""

PACE, PACE_S = (3, 8), 1.2
"""Sweeps over which an object's speed is taken: those of so many seconds, at least and at most."""

JOLT = 0.3
"""Metres that such an object may be off where its speed takes it: what is farther is something else that stands there."""


@dataclass(frozen=True)
class Cluster:
    """Points `[N, 3]` of one object in a sweep at `time_us`; `eye` `[3]`: the body then; `moved`: whether others saw through them."""

    xyz: np.ndarray
    time_us: int
    eye: np.ndarray
    moved: bool = True

    def middle(self) -> np.ndarray:
        return (self.xyz[:, :2].min(0) + self.xyz[:, :2].max(0)) / 2

    def away(self) -> float:
        """Metres from the body."""
        return float(np.linalg.norm(self.eye[:2] - self.middle()))

    def points_at(self, away: float) -> float:
        """How many points it would have at another distance: as many as it fills of the lidar's view."""
        return len(self.xyz) * (self.away() / away) ** 2


@dataclass(frozen=True)
class Patience:
    """How long objects are followed that are not seen, by whether they are believed, in seconds; how many sweeps must have `seen` one; and
    the `pace`, over how many its speed is taken."""

    lost: tuple[float, float]
    seen: int
    pace: int

    @staticmethod
    def of(times_us: Sequence[int]) -> Patience:
        """For sweeps at rising times."""
        step = float(np.median(np.diff(times_us))) / 1e6 if len(times_us) > 1 else LOST[0]
        seen, pace = (int(np.clip(round(seconds / step), *count)) for count, seconds in ((SEEN, SEEN_S), (PACE, PACE_S)))
        return Patience((max(LOST[0], SOON * step), max(LOST[1], SOON * step)), seen, pace)


class Followed:
    """An object's `clusters` so far, in time order, its middle in each, `places`, and the last cluster that moved, `known`."""

    def __init__(self, first: Cluster, patience: Patience):
        self.clusters, self.places, self.known, self.patience = [first], [first.middle()], first, patience

    def add(self, cluster: Cluster) -> None:
        """The next cluster that moved."""
        self.clusters.append(cluster)
        self.places.append(cluster.middle())
        self.known = cluster

    @property
    def believed(self) -> bool:
        return sum(c.moved for c in self.clusters) >= max(self.patience.seen, MOVED * len(self.clusters))

    def live(self, time_us: int) -> bool:
        return time_us - self.clusters[-1].time_us <= 1e6 * self.patience.lost[self.believed]

    def expected(self, time_us: int) -> tuple[np.ndarray, float]:
        """Where its middle should be at a time, `[2]`, and how far off that may be."""
        gap = (time_us - self.clusters[-1].time_us) / 1e6
        if len(self.clusters) == 1:
            return self.places[-1], GATE[0] + FASTEST * gap
        back = min(len(self.clusters), self.patience.pace)
        speed = (self.places[-1] - self.places[-back]) / (self.clusters[-1].time_us - self.clusters[-back].time_us) * 1e6
        return self.places[-1] + gap * speed, GATE[0] + GATE[1] * gap

    def stands(self, time_us: int, eye: np.ndarray, points: np.ndarray, tree: cKDTree) -> bool:
        """Go on with those of a sweep's `points` that have its last shape near where it should be; whether there are enough.

        `tree`: of the points from above."""
        expected, shape = self.expected(time_us)[0], self.known.xyz[:, :2] - self.known.middle()
        place = expected
        for _ in range(3):
            away, nearest = tree.query(shape + place, distance_upper_bound=ALIKE)
            near = np.isfinite(away)
            if near.mean() < PART:
                return False
            place = np.median(points[nearest[near], :2] - shape[near], axis=0)
        own = points[np.unique(nearest[near])]
        if len(own) < FEWEST or np.linalg.norm(place - expected) > JOLT:
            return False
        self.clusters.append(Cluster(own, time_us, eye, moved=False))
        self.places.append(place)
        return True


def follow(followed: list[Followed], found: list[Cluster], time_us: int, eye: np.ndarray, points: np.ndarray, patience: Patience) -> None:
    """Add a sweep's clusters to the objects that they continue, or as new ones (assignment by least total distance, Kuhn 1955).

    Of an object of which less is found than there was, all its `points` `[N, 3]` are taken."""
    live = [f for f in followed if f.live(time_us)]
    cost = np.full((len(live), len(found)), 1e3)
    for i, one in enumerate(live):
        place, off = one.expected(time_us)
        away = np.array([np.linalg.norm(c.middle() - place) for c in found])
        cost[i] = np.where(away < off, away, 1e3)
    next_of = {int(i): int(j) for i, j in zip(*linear_sum_assignment(cost), strict=True) if cost[i, j] < 1e3}
    tree = cKDTree(points[:, :2])
    for i, one in enumerate(live):
        less = i not in next_of or len(found[next_of[i]].xyz) < LESS * one.known.points_at(found[next_of[i]].away())
        if one.believed and less and one.stands(time_us, eye, points, tree):
            continue
        if i in next_of:
            one.add(found[next_of[i]])
    followed += [Followed(c, patience) for j, c in enumerate(found) if j not in next_of.values()]
