"""A body's way as a curve: how far along it, beside it and above it a place is."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from scenes.trajectory import Trajectory

MOVED = 0.05
"""Metres from a place of the path to the next, at least."""

LONG = 12.0
"""Metres beyond the path's ends for which it is drawn straight on."""


class Path:
    """A body's path `[N, 3]`, a point every metre, and straight on beyond its ends for `LONG`."""

    def __init__(self, ego: Trajectory):
        places = _apart(ego.world_from_body[:, :3, 3].numpy())
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places[:, :2], axis=0), axis=1))])
        at = np.arange(0.0, way[-1] + 1.0)
        inner = np.stack([np.interp(at, way, places[:, k]) for k in range(3)], 1)
        # as it goes over the first and last metres: a single pose shakes
        steps = min(len(inner) - 1, 5)
        ends = [(inner[e] - inner[o]) / max(1, steps) for e, o in ((0, steps), (-1, -1 - steps))]
        on = np.arange(1.0, LONG + 1.0)[:, None]
        self.places = np.concatenate([(inner[0] + on * ends[0])[::-1], inner, inner[-1] + on * ends[1]])
        self.length = way[-1]
        self.tree = cKDTree(self.places[:, :2])

    def beside(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of points `[N, 2]` how far along the path they are in metres, how far to its left, and how high it is there."""
        nearest = self.tree.query(xy)[1].clip(1, len(self.places) - 2)
        ahead = self.places[nearest + 1, :2] - self.places[nearest - 1, :2]
        ahead /= np.maximum(1e-9, np.linalg.norm(ahead, axis=1))[:, None]
        off = xy - self.places[nearest, :2]
        along = nearest + (off * ahead).sum(1)
        left = ahead[:, 0] * off[:, 1] - ahead[:, 1] * off[:, 0]
        return along, left, np.interp(along, np.arange(len(self.places)), self.places[:, 2])


def _apart(places: np.ndarray) -> np.ndarray:
    """Those of places `[N, 3]` that are off the last one that stays: who stands shakes, and of many poses a second all are close."""
    stay = [0]
    for i, place in enumerate(places[:, :2]):
        if np.linalg.norm(place - places[stay[-1], :2]) > MOVED:
            stay.append(i)
    return places[stay]
