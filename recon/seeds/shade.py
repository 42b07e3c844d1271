"""The shade that a mover takes along: what it keeps from the ground below and beside it, which no splat of a road that it drives over can
show."""

from __future__ import annotations

import numpy as np

from recon.log import Track
from recon.seeds.points import alike
from scenes.gaussians import Gaussians
from scenes.ground import Ground
from scenes.shade import BLACK

SPACING, WIDE = 0.4, 0.6
"""Metres between its splats, and the standard deviation of one along the ground, in spacings."""

BESIDE = 1.6
"""Metres beyond the box that it reaches: under a low sun that is short, but what is farther is half lit. With half of it the road beside
cars that pass drive 002's left camera comes to 33.2 dB, with this to 33.6, and to 31.3 without any."""

ABOVE, THICK = 0.02, 0.01
"""Metres above the ground in which it lies, and its thickness: it must be drawn over the road."""

LOGIT = -2.2
"""The logit of its opacity. Its colour stays; what the pictures do not hold up fades (`FADE` in `recon/fit/fit.py`)."""


def shade(track: Track, ground: Ground, sh_count: int) -> Gaussians:
    """Flat, dark, thin splats in a track's frame, on the ground under its box and around it, where the fit leaves them
    (`hold_shade` in `recon/fit/densify.py`)."""
    at = track.world_from_box[:, :3, 3]
    height = float((ground.height(at[:, :2].float()).double() - at[:, 2]).median()) + ABOVE
    half = track.size[:2] / 2 + BESIDE
    x, y = (np.linspace(-h, h, round(2 * h / SPACING) + 1) for h in half)
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    means = np.column_stack([xy, np.full(len(xy), height)])
    return alike(means, BLACK, (WIDE * SPACING, WIDE * SPACING, THICK), LOGIT, sh_count)
