"""Depth of what stands above the road, where the sweep of a picture's moment says nothing: by the points of all sweeps, and upwards.

Lidar's upper beams lie degrees apart and end 15 degrees up or lower. Between and above them an edge along the street, a cornice or a
roof, looks the same from the recorded path at any depth, and tears in views from aside.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from recon.log import Log, Track
from recon.objects.actors import Split
from recon.seeds.measured import Measured, as_known, grid_of, nearest_points
from recon.seeds.points import Cloud, nearest_box, thin
from recon.views.frames import Frames
from recon.views.view import View
from render.rays import camera_rays
from scenes.camera import Camera

POINTS = 300_000
"""Points of all sweeps together that are looked at, spread as seeds are."""

CLOSE = 40.0
"""Metres up to which things are taken to go on above what is known of them: what is farther hardly moves from aside, and behind low
houses stand towers."""

RISES, FURTHER = 0.05, 0.15
"""Tangents of the elevation from which on that is done, and by which it reaches above the highest that is known."""

BESIDE = 2
"""Columns to either side whose median, of what a row knows, tells how far a thing is: one beam among others that met a wire shall not
decide, though one alone above all others does. Where beams of drive 002's three front cameras are held back, 1.8 % of the pixels are then
more than a tenth off; 5.0 % if what stands below had a say, too."""

STANDING = 0.002
"""What mistakes weigh. It costs drive 002's held-out pictures some 0.05 dB; twice lidar's own weight (0.01) for all depths costs 0.3."""


def by_all_sweeps(log: Log, frames: Frames, split: Split, movers: list[Track]) -> Measured:
    """Of every training view, what is above the horizon and stands still; split: the sweeps' points."""
    path = cKDTree(log.ego.world_from_body[:, :3, 3].numpy())
    points = thin(Cloud(split.static, split.static), path.query(split.static)[0], POINTS)[0].xyz
    found = {}
    for view in frames.training():
        camera = grid_of(frames.camera(log, view))
        local = camera_rays(camera).double()
        rays = (local @ camera.world_from_cam[:3, :3].T).numpy()
        level = np.hypot(rays[..., 0], rays[..., 1])
        rise, away = rays[..., 2] / level, level / camera.lens.depth(local).numpy()  # metres over the ground in one of depth
        above = points[points[:, 2] > float(camera.world_from_cam[2, 3])]
        depth = np.where(rise > 0, nearest_points(above, camera, nearest_box(camera, movers)), np.nan)
        found[view.camera, view.index] = as_known(upwards(depth * away, rise, _on_grid(view, camera)) / away)
    return Measured(found, STANDING)


def upwards(metres: np.ndarray, rise: np.ndarray, sky: np.ndarray) -> np.ndarray:
    """Metres over the ground `[h, w]`, NaN where not known, with what stands above as far away as the highest known below it: walls and
    poles are upright.

    rise: the tangents of the pixels' elevations. It ends at the `sky`, `FURTHER` above what is known, and beyond `CLOSE`.
    """
    out, beside = metres.copy(), _median_beside(metres)
    carried, began = np.full((2, metres.shape[1]), np.nan)
    for row in range(len(metres) - 1, -1, -1):
        known = np.isfinite(beside[row])
        carried, began = np.where(known, beside[row], carried), np.where(known, rise[row], began)
        carried[sky[row] | ~(rise[row] >= RISES) | (rise[row] > began + FURTHER) | (carried > CLOSE)] = np.nan
        out[row] = np.where(np.isnan(metres[row]), carried, metres[row])
    return out


def _median_beside(metres: np.ndarray) -> np.ndarray:
    """The (lower) median of what is known of `BESIDE` columns to either side, NaN where nothing is."""
    padded = np.pad(metres, ((0, 0), (BESIDE, BESIDE)), constant_values=np.nan)
    around = np.sort(np.lib.stride_tricks.sliding_window_view(padded, 2 * BESIDE + 1, axis=1), axis=2)  # NaN last
    middle = np.maximum(np.isfinite(around).sum(2) - 1, 0) // 2
    return np.take_along_axis(around, middle[..., None], 2)[..., 0]


def _on_grid(view: View, camera: Camera) -> np.ndarray:
    """A view's sky on a camera's pixels."""
    rows, columns = (np.arange(n) * of // n for n, of in zip((camera.height, camera.width), view.sky.shape, strict=True))
    return view.sky.numpy()[rows[:, None], columns]
