"""Pictures of different exposure brought to one: a gain a picture and channel, from the points that several pictures show.

Gain compensation after Brown and Lowe (2007, section 6), by medians: a point's colour in a picture is its own colour times the
picture's gain. Photos are exposed one by one, so unlike a rig's cameras they cannot share one exposure.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

FEWEST = 20
"""Shared points that a gain needs; a picture with fewer keeps 1."""

DARK, BRIGHT = 0.06, 0.92
"""Colours outside say nothing about exposure: noise and clipping."""


def picture_gains(colours: Sequence[np.ndarray], points: Sequence[np.ndarray], count: int) -> np.ndarray:
    """Gains `[F, 3]`, geometric mean 1, of pictures whose `points[f]` `[P]` (of `count`) have `colours[f]` `[P, 3]` in 0..1."""
    logs = np.full((len(colours), 3), 0.0)
    usable = [(c > DARK).all(1) & (c < BRIGHT).all(1) for c in colours]
    kept = [(np.log(c[u]), p[u]) for c, p, u in zip(colours, points, usable, strict=True)]
    seen = np.bincount(np.concatenate([p for _, p in kept]), minlength=count) if kept else np.zeros(count)
    kept = [(c[seen[p] > 1], p[seen[p] > 1]) for c, p in kept]
    for _ in range(30):
        total, number = np.zeros((count, 3)), np.zeros(count)
        for gain, (colour, shown) in zip(logs, kept, strict=True):
            np.add.at(total, shown, colour - gain)
            np.add.at(number, shown, 1)
        own = total / np.maximum(number, 1)[:, None]
        logs = np.array([np.median(c - own[p], axis=0) if len(p) >= FEWEST else np.zeros(3) for c, p in kept])
        logs -= logs.mean(0)
    return np.exp(logs)
