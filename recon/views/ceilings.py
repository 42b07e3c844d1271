"""What looks like the sky where a small robot drives, but is a ceiling: it moves through the pictures as what is near does.

Above what lidar's beams and pictures' points tell, a white ceiling looks like a white sky. But a sky shows from elsewhere what it showed,
turned as the camera is; lamps, seams and upper walls do not, and agree at some distance instead (a plane sweep, Collins 1996).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage

from recon.log import Log
from recon.views.view import View
from render.rays import world_directions
from scenes.camera import Camera
from scenes.poses import inverse
from scenes.spread import spread

ROOM, MOST = 12.0, 0.95
"""Metres within which most of what stands must be for there to be a ceiling, and how much that is: along a street one sees farther."""

LOOKS, LEAST = 12, 0.01
"""Views of a camera that are asked, of those of which more than this part is said to be sky."""

BASELINE, ALLOWED, TURNED = 0.06, 2.5, 0.8
"""Distance to the view that one is compared with, in distances to the farthest of what stands, how many times more or less is allowed, and
the cosine between their directions at least."""

HEIGHTS = np.geomspace(0.5, 24, 18)
"""Heights of ceilings, and distances of walls, that are tried, in baselines."""

WINDOW, UNLIKE, BETTER = 7, 3.0, 0.5
"""Cells across that are compared; levels that a sky must be unlike itself, but for a window's mean, to be doubted; and the part of that
which is left at the right distance."""

DOUBTED = 0.02
"""Part of the sky that is so in half of the views, from which on all of it is a ceiling: much of one is too plain to tell."""

FAR = 1e4
"""Baselines at which the sky is."""


def without_ceilings(log: Log, names: Sequence[str], views: list[View], far: float) -> list[View]:
    """The views, without the skies of cameras that show a ceiling instead. far: metres from the cameras within which `MOST` of what stands
    is."""
    if far > ROOM or not log.meta.get("metric", True):
        return views
    roofed = []
    for c, name in enumerate(names):
        seen = [_Seen.of(log, name, v) for v in views if v.camera == c]
        asked = spread([s for s in seen if s.sky.mean() > LEAST], LOOKS)
        doubted = [_doubted(one, other) for one in asked if (other := _beside(one, seen, BASELINE * far)) is not None]
        if doubted and np.median(doubted) > DOUBTED:
            print(f"{log.path}: what looks like the sky to {name} moves as a ceiling does, and is taken for one", file=sys.stderr)
            roofed.append(c)
    return [replace(v, sky=torch.zeros_like(v.sky)) if v.camera in roofed else v for v in views]


@dataclass(frozen=True)
class _Seen:
    """A view on the grid of its sky `[h, w]`: its camera there, and how bright it is, float `[h, w]`."""

    camera: Camera
    grey: np.ndarray
    sky: np.ndarray

    @staticmethod
    def of(log: Log, name: str, view: View) -> _Seen:
        height, width = view.sky.shape
        grey = view.image.float().mean(-1)[None, None]
        small = torch.nn.functional.interpolate(grey, (height, width), mode="area")[0, 0].numpy()
        return _Seen(log.camera(name).camera(view.index, width, height), small, view.sky.numpy())

    @property
    def eye(self) -> np.ndarray:
        return self.camera.world_from_cam[:3, 3].numpy()

    def shown(self, points: np.ndarray) -> np.ndarray:
        """How bright it is at world points `[h, w, 3]`; NaN at those that it does not show."""
        back = inverse(self.camera.world_from_cam).numpy()
        local = torch.from_numpy(points @ back[:3, :3].T + back[:3, 3])
        x, y = np.moveaxis(self.camera.lens.project(local).numpy(), -1, 0)
        seen = ((local[..., 2] > 0) & self.camera.lens.valid(local)).numpy()
        inside = seen & (x > 0) & (x < self.camera.width) & (y > 0) & (y < self.camera.height)
        at = [np.where(inside, v - 0.5, 0.0) for v in (y, x)]
        return np.where(inside, ndimage.map_coordinates(self.grey, at, order=1, mode="nearest"), np.nan)


def _beside(one: _Seen, others: Sequence[_Seen], apart: float) -> _Seen | None:
    """The view that was taken about so many metres from one, and looks where it does."""
    away = np.array([np.linalg.norm(other.eye - one.eye) for other in others])
    along = np.array([float(other.camera.world_from_cam[:3, 2] @ one.camera.world_from_cam[:3, 2]) for other in others])
    off = np.where(along > TURNED, np.abs(np.log(np.maximum(away, 1e-9) / apart)), np.inf)
    return others[int(off.argmin())] if off.min() < np.log(ALLOWED) else None


def _doubted(one: _Seen, other: _Seen) -> float:
    """Part of a view's sky that another one shows as if it were near."""
    ways = world_directions(one.camera).double().numpy()
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    apart = float(np.linalg.norm(other.eye - one.eye))
    level = np.maximum(ways[..., 2], 1e-3)

    def unlike(distance: np.ndarray | float) -> np.ndarray:
        off = other.shown(one.eye + ways * np.broadcast_to(distance, level.shape)[..., None]) - one.grey
        known = np.isfinite(off)
        off = np.where(known, off, 0.0)
        off = np.abs(off - ndimage.uniform_filter(off, WINDOW))
        return np.where(ndimage.minimum_filter(known, WINDOW), ndimage.uniform_filter(off, WINDOW), np.inf)

    sky = ndimage.binary_erosion(one.sky, iterations=WINDOW // 2)
    as_sky = unlike(FAR * apart)
    sky &= np.isfinite(as_sky)
    near = np.minimum.reduce([unlike(d) for h in HEIGHTS * apart for d in (h / level, h)])
    return float((sky & (as_sky > UNLIKE) & (near < BETTER * as_sky)).sum() / max(sky.sum(), 1))
