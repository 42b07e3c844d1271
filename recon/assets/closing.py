"""The end of a vehicle that no photo shows: closed, as far as its sides tell where it ends.

A car that drives ahead is never seen from its front, one that comes towards the camera never from behind; cut out and turned, it is a
shell. Its sides, seen or mirrored, say how far it reaches at each height and how wide it is there: the hull of both closes it (a visual
hull, Laurentini 1994, of two silhouettes), in the colours that its sides have at that height. No lamps, no number plate: a guess, and told
as one (`scenes/seen.py`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree

from recon.seeds.points import Cloud, splats_from
from recon.tracks import VEHICLES
from scenes.asset import Asset
from scenes.gaussians import Gaussians
from scenes.harmonics import rgb_from_sh
from scenes.seen import unseen_sides

ENDS = {"front": 1.0, "rear": -1.0}
"""Sides that are closed, and where they are along x."""

ROW = 0.08
"""Metres between the heights at which a vehicle's outline is taken."""

CLEARANCE = 0.25
"""Metres above the ground at which an end begins."""

STEP = 0.05
"""Metres between the splats that close it."""

THERE = 0.15
"""Metres within which what was reconstructed is kept, and nothing added."""

SOLID = 0.3
"""Opacity from which on a splat is a part of the outline."""

ROUND = 0.75
"""Metres over which an end curves into the sides."""

FEWEST = 20
"""Splats in a row from which on its outline is known."""

ALIKE = 48
"""Nearest splats of the sides whose median colour a splat gets; what differs in height counts `LEVEL` times as far."""
LEVEL = 3.0


def closed(asset: Asset) -> Asset:
    """A vehicle with those of its ends closed of which nobody took a photo (`unseen_sides`); `meta["closed"]` names them."""
    names = [name for name in unseen_sides(asset) if name in ENDS] if asset.label in VEHICLES else []
    hulls = {name: hull_of_end(asset.gaussians, asset.size.numpy(), ENDS[name]) for name in names}
    done = [name for name, hull in hulls.items() if len(hull)]
    return replace(asset, gaussians=Gaussians.cat([asset.gaussians, *hulls.values()]), meta=asset.meta | {"closed": done})


def hull_of_end(splats: Gaussians, size: np.ndarray, end: float) -> Gaussians:
    """Splats that close the front (`end` 1) or rear (-1) of those in a box `[length, width, height]`, where there are none; those have one
    colour from all sides."""
    solid = splats.select(torch.sigmoid(splats.logit_opacities) > SOLID)
    points = solid.means.double().numpy() * [end, 1, 1]
    outline = _outline(points, size)
    if outline is None:
        return Gaussians.empty(splats.sh.shape[1])
    surface = _ruled(*outline)
    surface = surface[cKDTree(points).query(surface)[0] > THERE]
    if not len(surface):
        return Gaussians.empty(splats.sh.shape[1])
    alike = np.abs(points) * [1, 1, LEVEL]
    nearest = cKDTree(alike).query(np.abs(surface) * [1, 1, LEVEL], k=min(ALIKE, len(alike)))[1]
    colours = np.median(rgb_from_sh(solid.sh[:, 0]).numpy()[nearest.reshape(len(surface), -1)], axis=1)
    cloud = Cloud(surface * [end, 1, 1], colours)
    return splats_from(cloud, np.full(len(surface), STEP), splats.sh.shape[1], STEP)


def _outline(points: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
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


def _ruled(heights: np.ndarray, ahead: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """Points `[M, 3]` every `STEP` metres of the surface that an outline spans from side to side, curved into the sides."""
    along = np.concatenate([[0.0], np.hypot(np.diff(heights), np.diff(ahead)).cumsum()])
    at = np.arange(0, along[-1], STEP)
    z, x, half = (np.interp(at, along, a) for a in (heights, ahead, beside))
    normal = np.stack([np.gradient(z), -np.gradient(x)], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    rows = []
    for z0, x0, w, (nx, nz) in zip(z, x, half, normal, strict=True):
        y = np.arange(-w, w + STEP / 2, STEP)
        bent = ((np.abs(y) - w) / ROUND + 1).clip(0, 1)
        sunk = ROUND * (1 - np.sqrt(1 - bent * bent))
        rows.append(np.stack([x0 - sunk * nx, y, z0 - sunk * nz], 1))
    return np.concatenate(rows)
