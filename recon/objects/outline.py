"""How far a vehicle reaches at each height, towards its front or rear and to the sides."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

CLEARANCE = 0.25
"""Metres above the ground at which a vehicle's ends and sides begin."""

ROW = 0.08
"""Metres between the heights at which a vehicle's outline is taken."""

FEWEST = 20
"""Splats in a row from which on its outline is known."""


def outline(points: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Of points `[N, 3]`: heights, how far ahead they reach at each (what is higher up has something below it), and how far to the sides
    there; None of too few."""
    heights = np.arange(CLEARANCE, size[2], ROW)
    ahead, beside = np.full((2, len(heights)), np.nan)
    for i, z in enumerate(heights):
        row = points[np.abs(points[:, 2] - z) < ROW]
        if len(row) >= FEWEST:
            ahead[i] = np.percentile(row[:, 0], 98)
            near = row[row[:, 0] > ahead[i] - size[1] / 2]
            beside[i] = np.percentile(np.abs(near[:, 1]), 95)
    known = np.isfinite(ahead)
    if known.sum() < 3:
        return None
    top = np.flatnonzero(known)[-1] + 1
    heights, ahead, beside = (np.interp(heights[:top], heights[known], a[known]) for a in (heights, ahead, beside))
    ahead, beside = (ndimage.median_filter(a, 3, mode="nearest") for a in (ahead, beside))
    return heights, np.maximum.accumulate(ahead[::-1])[::-1], beside
