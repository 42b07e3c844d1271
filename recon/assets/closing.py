"""The end of a vehicle that no photo shows: closed, as far as its sides tell where it ends.

A car that drives ahead is never seen from its front, one that comes towards the camera never from behind; cut out and turned, it is a
shell. Its sides, seen or mirrored, say how far it reaches at each height and how wide it is there: the hull of both closes it (a visual
hull, Laurentini 1994, of two silhouettes), in the colours that its sides have at that height. No lamps, no number plate: a guess, and told
as one (`scenes/seen.py`).

What stood before an end hid it in part, from all photos of a row of parked cars: a hole, through which the street shows. Of an end that
photos show, the same hull closes what lets light through.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree

from recon.seeds.points import Cloud, splats_from
from recon.tracks import VEHICLES
from render import Frame, rasterize
from scenes.asset import Asset
from scenes.camera import Camera
from scenes.gaussians import Gaussians
from scenes.harmonics import rgb_from_sh
from scenes.lenses import Orthographic
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

OPAQUE = 0.8
"""Alpha from which on an end has no hole."""

HOLE = 6
"""Points within two steps of one, itself among them, from which on what lets light through is a hole; 13 where all do."""

PIXEL = 0.02
"""Metres of a pixel in which holes are looked for."""

ROUND = 0.75
"""Metres over which an end curves into the sides."""

FEWEST = 20
"""Splats in a row from which on its outline is known."""

LAMPS = 0.6
"""Metres from the other end whose colours, lamps' and a plate's, an end that nobody saw does not get."""

ALIKE = 48
"""Nearest splats of the sides whose median colour a splat gets; what differs in height counts `LEVEL` times as far."""
LEVEL = 3.0


def closed(asset: Asset) -> Asset:
    """A vehicle with those of its ends closed of which nobody took a photo (`unseen_sides`), which `meta["closed"]` names, and with the
    holes of the others closed."""
    unseen, splats, done = unseen_sides(asset), asset.gaussians, []
    if asset.label in VEHICLES and asset.meta.get("sectors"):
        for name in sorted(ENDS, key=lambda end: end not in unseen):  # what closes an end reaches up to the roof, where no hole is then
            hull = hull_of_end(splats, asset.size.numpy(), ENDS[name], name not in unseen)
            splats = Gaussians.cat([splats, hull])
            done += [name] if name in unseen and len(hull) else []
    return replace(asset, gaussians=splats, meta=asset.meta | {"closed": done})


def hull_of_end(splats: Gaussians, size: np.ndarray, end: float, seen: bool = False) -> Gaussians:
    """Splats that close the front (`end` 1) or rear (-1) of those in a box `[length, width, height]`: where light passes them and, of an
    end that was not seen, where there are none. They have one colour from all sides."""
    solid = splats.select(torch.sigmoid(splats.logit_opacities) > SOLID)
    points = solid.means.double().numpy() * [end, 1, 1]
    outline = _outline(points, size)
    if outline is None:
        return Gaussians.empty(splats.sh.shape[1])
    surface = _ruled(*outline)
    lacking = lets_through(splats, size, end, surface * [end, 1, 1])
    if not seen:
        lacking |= cKDTree(points).query(surface)[0] > THERE
    surface = surface[lacking]
    if seen and len(surface):  # a hole is wider than the edge of a bumper
        surface = surface[cKDTree(surface).query_ball_point(surface, 2.1 * STEP, return_length=True) >= HOLE]
    else:
        donors = points[:, 0] > LAMPS - size[0] / 2
        points, solid = points[donors], solid.select(torch.from_numpy(donors))
    if not len(surface) or not len(points):
        return Gaussians.empty(splats.sh.shape[1])
    alike = np.abs(points) * [1, 1, LEVEL]
    nearest = cKDTree(alike).query(np.abs(surface) * [1, 1, LEVEL], k=min(ALIKE, len(alike)))[1]
    colours = np.median(rgb_from_sh(solid.sh[:, 0]).numpy()[nearest.reshape(len(surface), -1)], axis=1)
    cloud = Cloud(surface * [end, 1, 1], colours)
    return splats_from(cloud, np.full(len(surface), STEP), splats.sh.shape[1], STEP)


def lets_through(splats: Gaussians, size: np.ndarray, end: float, points: np.ndarray) -> np.ndarray:
    """Mask `[M]` of points `[M, 3]` where some light passes the half of a vehicle at its front (`end` 1) or rear (-1), seen along x."""
    half = splats.select(splats.means[:, 0] * end > 0)
    columns, rows = (math.ceil(metres / PIXEL) for metres in size[1:])
    # the camera looks backwards at a front and forwards at a rear
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[0.0, 0.0, -end], [end, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pose[0, 3] = end * size[0]
    camera = Camera(Orthographic(1 / PIXEL, 1 / PIXEL, columns / 2, float(rows)), columns, rows, pose)
    with torch.no_grad():
        frame = rasterize(half, camera, ("alpha",))
    assert isinstance(frame, Frame) and frame.alpha is not None
    column, row = camera.lens.project((torch.from_numpy(points) - pose[:3, 3]) @ pose[:3, :3]).floor().long().unbind(1)
    return (frame.alpha[row.clamp(0, rows - 1), column.clamp(0, columns - 1)] < OPAQUE).numpy()


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
