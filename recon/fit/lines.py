"""What pictures show to lie along the street lies along it in space: wires, cornices, edges of roofs, rows of windows.

Moved along itself an edge looks the same (the aperture problem), so a drive along a street tells of an edge along that street neither how
far away it is nor how it is turned in the plane of it and the eye. Splats that look like it stand at many depths and square to the view,
and from aside they part into dashes. That edges which lead to where the street vanishes are along it is taken for granted, as of other
streets (Coughlan and Yuille 1999, "Manhattan world").
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree

from recon.fit.clear import Clear
from recon.fit.model import Splats
from recon.way import Path
from scenes.camera import Camera
from scenes.poses import inverse, matrix_from_quat, quat_from_matrix
from scenes.trajectory import Trajectory

STRAIGHTENED_AT = (0.25, 0.32, 0.39, 0.46, 0.53, 0.6, 0.67, 0.74, 0.79, 0.86, 0.93)
"""Parts of the fit at which it is done: in between, the pictures pull them off again."""

LOOKS = 16
"""Pictures of a camera, spread over the drive, of which the nearest that has a splat says how that looks."""

ABOVE = 0.3
"""Metres above the eye from which on splats are looked at: below, depth is measured, and the road is flat already."""

ALIGNED = math.radians(8)
"""How far off the street's direction, as it looks, what lies along it may be."""

SURELY = math.radians(1)
"""By how much nearer to level than to the street's direction it must look to be taken to be level: wires climb with a street, and cornices
do not."""

LONGER, PLAIN = 2.5, 1e-3
"""How many times as long as wide it looks, at least, and how long, in radians: a pixel of 960 in an angle of view of 50 degrees."""

REACHES = 0.1
"""Of its distance, the standard deviation along the street that it may get: what would have to be longer is too much foreshortened."""

ROOM = 8.0
"""Times what it measures in the plane of it and the eye, which no picture shows, that it may be long: less than `LONGEST`
(`recon/fit/densify.py`), so that it can grow until the next time. With what it was, wires were dotted lines."""

SMOOTH = 9
"""Metres of the path over which its direction is averaged."""

BESIDE, ALONG, DEEPER = math.radians(0.15), 6.0, 0.35
"""Splats are of one edge that lie in one plane with the path to so much, so many metres along it apart at most, and as far away from it up
to this part."""

PULLED, HELD = 0.5, 4.0
"""Of what they are off that edge's distance, what they move at once; those where lidar saw something stay, and count so many times."""

FAINT = 0.05
"""Opacity from which on splats count."""

BENDS, OVER = math.radians(10), 10
"""Where the path turns by more over so many metres before and behind, what lies along it is not ambiguous, nor straight."""


class StreetLines:
    """Straightens what of a background lies along a body's path, by how cameras on it see that."""

    def __init__(self, path: Trajectory, cameras: Sequence[Camera], clear: Clear):
        self.path, self.cameras, self.clear = Path(path), cameras, clear
        ways = np.gradient(self.path.places, axis=0)
        ways = ndimage.uniform_filter1d(ways / np.linalg.norm(ways, axis=1).clip(1e-9)[:, None], SMOOTH, axis=0, mode="nearest")
        self.ways = ways / np.linalg.norm(ways, axis=1).clip(1e-9)[:, None]
        place = np.arange(len(ways))
        before, after = (self.ways[place.clip(OVER, place[-1] - OVER) + way] for way in (-OVER, OVER))
        self.straight = (before * after).sum(1) > math.cos(BENDS)  # nowhere along the path of who stands
        eyes = torch.stack([camera.world_from_cam[:3, 3].detach() for camera in cameras]).numpy()
        self.height = float(np.median(eyes[:, 2] - self.path.beside(eyes[:, :2])[2]))

    def straighten(self, splats: Splats) -> int:
        """Turn and move splats, in place, so that the cameras' pictures stay. Returns how many."""
        fields = {
            name: splats.fields[name][: splats.sizes[0]].detach().cpu().double() for name in ("means", "quats", "log_scales", "logits")
        }
        scales, means = fields["log_scales"].exp(), fields["means"].numpy()
        may = (torch.sigmoid(fields["logits"]) > FAINT) & (scales.amax(1) > LONGER * scales.amin(1))
        which = np.flatnonzero(may.numpy())
        along, around, away, ways, asked = self._about(means[which])
        which, along, around, away, ways = _only(asked, which, along, around, away, ways)
        eyes, seen = _nearest_eyes(means[which], self.cameras)
        which, along, around, away, ways, eyes = _only(seen, which, along, around, away, ways, eyes)
        axes = (matrix_from_quat(fields["quats"][which]) * scales[which, None]).numpy()
        turned, lengths, long = _turned(means[which] - eyes, axes, ways)
        which, along, around, away, eyes = _only(long, which, along, around, away, eyes)
        if not len(which):
            return 0
        weights = (torch.sigmoid(fields["logits"][which]) * scales[which].amax(1).sqrt()).numpy()
        held = self.clear.struck(means[which])
        off = _off_edges(np.stack([around / BESIDE, along / ALONG], 1), np.log(away), np.where(held, HELD, 1.0) * weights)
        nearer = np.exp(np.where(held, 0.0, PULLED * off))
        # what came to where lidar looked through would be removed
        nearer[self.clear.seen_through(eyes + nearer[:, None] * (means[which] - eyes))] = 1.0
        moved = {
            "means": torch.from_numpy(eyes + nearer[:, None] * (means[which] - eyes)),
            "quats": quat_from_matrix(torch.from_numpy(turned)),
            "log_scales": torch.from_numpy(np.log(np.maximum(nearer[:, None] * lengths, 1e-6))),
        }
        for name, values in moved.items():
            splats.fields[name][which] = values.to(splats.fields[name])
        return len(which)

    def _about(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of points `[N, 3]`: metres along the line on which the cameras drive, the angle around it, the distance from it, its direction
        `[N, 3]` there, and whether they are above it where it is straight."""
        nearest = self.path.tree.query(points[:, :2])[1]
        ways = self.ways[nearest]
        off = points - self.path.places[nearest] - [0, 0, self.height]
        on = (off * ways).sum(1)
        off = off - on[:, None] * ways
        left = np.stack([-ways[:, 1], ways[:, 0], np.zeros(len(ways))], 1)
        left /= np.linalg.norm(left, axis=1).clip(1e-9)[:, None]
        aside, up = (off * left).sum(1), (off * np.cross(ways, left)).sum(1)
        return nearest + on, np.arctan2(up, aside), np.hypot(aside, up), ways, (up > ABOVE) & self.straight[nearest]


def _only(mask: np.ndarray, *arrays: np.ndarray) -> list[np.ndarray]:
    return [array[mask] for array in arrays]


def _nearest_eyes(points: np.ndarray, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """The nearest eye `[N, 3]` of a camera that has points `[N, 3]` in its picture, and whether any has, bool `[N]`."""
    eyes, nearest = np.zeros_like(points), np.full(len(points), np.inf)
    for camera in cameras:
        pose = camera.world_from_cam.detach()
        back = inverse(pose)
        local = torch.from_numpy(points) @ back[:3, :3].T + back[:3, 3]
        pixels, size = camera.lens.project(local), torch.tensor([camera.width, camera.height])
        away = local.norm(dim=1).numpy()
        has = (camera.lens.valid(local) & ((pixels >= 0) & (pixels < size)).all(1)).numpy() & (away < nearest)
        eyes[has], nearest[has] = pose[:3, 3].numpy(), away[has]
    return eyes, np.isfinite(nearest)


def _turned(rays: np.ndarray, axes: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which ellipsoids, bool `[N]`, whose scaled `axes` are the columns of `[N, 3, 3]`, look from `rays` `[N, 3]` away as what lies along
    `ways` `[N, 3]`, or level above them; and of those rotations `[M, 3, 3]` and standard deviations `[M, 3]` that lie so and look the
    same."""
    away = np.linalg.norm(rays, axis=1)
    rays = rays / away[:, None]
    level = ways * [1, 1, 0]
    level /= np.linalg.norm(level, axis=1).clip(1e-9)[:, None]
    aslant, _, _ = _looks(rays, axes, ways)
    ways = np.where((_looks(rays, axes, level)[0] < aslant - SURELY)[:, None], level, ways)
    off, long, wide = _looks(rays, axes, ways)
    across = np.cross(rays, ways)
    foreshortened = np.linalg.norm(across, axis=1)
    across = across / np.maximum(foreshortened, 1e-9)[:, None]
    lengths = long / np.maximum(foreshortened, 1e-9)
    which = (off < ALIGNED) & (long > LONGER * wide) & (long > PLAIN * away) & (lengths < REACHES * away)
    rotations = np.stack([ways, across, np.cross(ways, across)], 2)[which]
    thin = np.maximum(np.minimum(wide, np.linalg.norm(axes, axis=1).min(1)), lengths / ROOM)
    return rotations, np.stack([lengths, wide, thin], 1)[which], which


def _looks(rays: np.ndarray, axes: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far off `ways` `[N, 3]` ellipsoids look turned from rays `[N, 3]`, in radians, and how long and how wide they look, `[N]`."""
    across = np.cross(rays, ways)
    across = across / np.maximum(np.linalg.norm(across, axis=1), 1e-9)[:, None]
    seen = np.stack([np.cross(across, rays), across], 1) @ axes  # along them as that looks, and at right angles to it
    (xx, xy), (_, yy) = np.moveaxis(seen @ seen.transpose(0, 2, 1), 0, 2)
    middle, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    return np.abs(np.arctan2(2 * xy, xx - yy)) / 2, np.sqrt(middle + half), np.sqrt(np.maximum(middle - half, 0))


def _off_edges(places: np.ndarray, logs: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """By how much the logarithms `[N]` of distances are less than the middle one of all those of the same edge, by `weights` `[N]`: places
    `[N, 2]` are of one edge up to 1 apart."""
    off = np.zeros(len(logs))
    for i, near in enumerate(cKDTree(places).query_ball_point(places, 1.0)):
        same = np.array(near)
        same = same[np.abs(logs[same] - logs[i]) < DEEPER]
        order = same[np.argsort(logs[same])]
        total = np.cumsum(weights[order])
        off[i] = logs[order[np.searchsorted(total, total[-1] / 2)]] - logs[i]
    return off
