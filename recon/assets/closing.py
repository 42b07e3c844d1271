"""The end of a vehicle that no photo shows: closed, as far as its sides tell where it ends.

A car that drives ahead is never seen from its front, one that comes towards the camera never from behind; cut out and turned, it is a
shell. Its sides, seen or mirrored, say how far it reaches at each height and how wide it is there: the hull of both closes it (a visual
hull, Laurentini 1994, of two silhouettes), in the colours that its sides have at that height. No lamps, no number plate: a guess, and told
as one (`scenes/seen.py`).

What stood before an end hid it in part, from all photos of a row of parked cars: a hole, through which the street shows. Of an end that
photos show, the same hull closes what lets light through; those of the sides are closed in `patching.py`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from recon.assets.patching import OPAQUE, STEP, in_colours_of, patched, shown_alone
from recon.objects.mirror import SOLID, THERE
from recon.objects.outline import outline
from recon.objects.tracks import VEHICLES
from scenes.asset import Asset
from scenes.gaussians import Gaussians
from scenes.seen import unseen_sides

ENDS = {"front": 1.0, "rear": -1.0}
"""Sides that are closed, and where they are along x."""

HOLE = 6
"""Points within two steps of one, itself among them, from which on what lets light through is a hole; 13 where all do."""

ROUND = 0.75
"""Metres over which an end curves into the sides."""

LAMPS = 0.6
"""Metres from the other end whose colours, lamps' and a plate's, an end that nobody saw does not get."""


def closed(asset: Asset) -> Asset:
    """A vehicle with those of its ends closed of which nobody took a photo (`unseen_sides`), which `meta["closed"]` names, and with the
    holes of the others and of both sides closed; `meta["patched_m2"]` says how much of the sides that is."""
    unseen, splats, done, area = unseen_sides(asset), asset.gaussians, [], 0.0
    if asset.label in VEHICLES and asset.meta.get("sectors"):
        for name in sorted(ENDS, key=lambda end: end not in unseen):  # what closes an end reaches up to the roof, where no hole is then
            hull = hull_of_end(splats, asset.size.numpy(), ENDS[name], name not in unseen)
            splats = Gaussians.cat([splats, hull])
            done += [name] if name in unseen and len(hull) else []
        patches, area = patched(splats, asset.size.numpy())
        splats = Gaussians.cat([splats, patches])
    return replace(asset, gaussians=splats, meta=asset.meta | {"closed": done, "patched_m2": round(area, 2)})


def hull_of_end(splats: Gaussians, size: np.ndarray, end: float, seen: bool = False) -> Gaussians:
    """Splats that close the front (`end` 1) or rear (-1) of those in a box `[length, width, height]`: where light passes them and, of an
    end that was not seen, where there are none. They have one colour from all sides."""
    solid = splats.select(torch.sigmoid(splats.logit_opacities) > SOLID)
    points = solid.means.double().numpy() * [end, 1, 1]
    shape = outline(points, size)
    if shape is None:
        return Gaussians.empty(splats.sh.shape[1])
    surface = _ruled(*shape)
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
    # of either side; the other end has other colours, tail lamps' where this one's are a grille's
    return in_colours_of(solid, surface * [end, 1, 1], _on_left(points), _on_left(surface))


def lets_through(splats: Gaussians, size: np.ndarray, end: float, points: np.ndarray) -> np.ndarray:
    """Mask `[M]` of points `[M, 3]` where some light passes the half of a vehicle at its front (`end` 1) or rear (-1), seen along x."""
    camera, frame = shown_alone(splats, size, 0, end)
    assert frame.alpha is not None
    pose, rows, columns = camera.world_from_cam, camera.height, camera.width
    column, row = camera.lens.project((torch.from_numpy(points) - pose[:3, 3]) @ pose[:3, :3]).floor().long().unbind(1)
    return (frame.alpha[row.clamp(0, rows - 1), column.clamp(0, columns - 1)] < OPAQUE).numpy()


def _on_left(points: np.ndarray) -> np.ndarray:
    """Points `[N, 3]` of both sides on the left one."""
    return np.stack([points[:, 0], np.abs(points[:, 1]), points[:, 2]], 1)


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
