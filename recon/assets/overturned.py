"""Whether a thing stands on its head: cars and cones are shorter above than below, whatever their make."""

from __future__ import annotations

import torch

from scenes.names import slug

TAPERED = ("car", "pickup", "cone")
"""Classes of which all are."""

PART, OUTER = 0.3, 0.02
"""Of a thing's height: its lower and its upper part. Of the points of each, on either end, those that do not count for its length."""

MOST = 100_000
"""Points that are asked."""

MORE = 0.1
"""Of a thing's length by which its upper part is longer, from which it is overturned. Upright it is at least 0.13 shorter: a pickup's."""


def overturned(label: str, points: torch.Tensor) -> bool:
    """Whether points `[N, 3]` on a thing of a class, x forward and z up, are those of one that stands on its head."""
    if slug(label) not in TAPERED or not len(points):
        return False
    x, z = points[:: 1 + len(points) // MOST, 0::2].T
    low, high = z.quantile(torch.tensor([OUTER / 10, 1 - OUTER / 10]).to(z))
    share = (z - low) / (high - low).clamp_min(1e-6)
    lower, upper = _length(x[share < PART]), _length(x[share > 1 - PART])
    return upper - lower > MORE * _length(x)


def _length(x: torch.Tensor) -> float:
    """From end to end of points `[N]` along x; 0 of none."""
    if not len(x):
        return 0.0
    first, last = x.sort().values[[int(OUTER * (len(x) - 1)), int((1 - OUTER) * (len(x) - 1))]]
    return float(last - first)
