"""What kind of sky a drive has, and which cells of its views surely show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage

from recon.log import Log
from recon.project import project
from recon.skies import WHITE, SkyKind, like_sky, sky_mask
from recon.view import View
from scenes.camera import Camera
from scenes.poses import inverse
from scenes.spread import spread

RIM = 6
"""Cells, of about 240 across an image, by which what looks like the sky beside it may reach into its rim."""

BLUE = 0.02
"""Part of a drive's pictures from which on their sky is blue, and no other colour is taken for it, but for clipped white beside it."""

DAZZLED = 1.2
"""How many times as much sky there must be with what is clipped for that to be taken for it."""

SWEEPS = 16
"""Sweeps, spread over the span, by which is told what is no sky."""

STRUCK, AROUND = 0.1, 7
"""Part of what looks like sky in so many columns, as far up as beams go, from which on, where lidar strikes it, it is a wall."""

STRAY = 0.005
"""Part of a sweep's points in a picture that may lie above where its beams go in general."""


def under_their_sky(log: Log, names: list[str], views: list[View]) -> tuple[list[View], SkyKind]:
    """The views, and which of `SkyKind` theirs is: then each is told its sky as such a one is known.

    One that is not blue takes colour, and what lidar strikes is left out: a white wall fits the description as well. Beside blue, white is
    sky only where there is lidar to tell.
    """
    blue = float(np.mean([v.sky.float().mean() for v in views]))
    within = log.sweeps_within((min(v.time_us for v in views), max(v.time_us for v in views)))
    if (blue >= BLUE and not within) or all(_colourless(v.image) for v in views[:: max(1, len(views) // 8)]):
        return views, "blue"
    chosen = spread(within, SWEEPS)
    points = [s.read().xyz for s in chosen]
    kind: SkyKind = "blinding" if blue >= BLUE else "overcast"
    more = DAZZLED if blue >= BLUE else 2
    if kind == "blinding" and float(np.mean([(v.image[::4, ::4].amin(-1) >= WHITE).float().mean() for v in views])) < blue * (DAZZLED - 1):
        return views, "blue"
    told = []
    for view in views:
        sky = coarse_sky(view.image, view.ego, kind).numpy()
        if chosen:
            nearest = min(range(len(chosen)), key=lambda i: abs(chosen[i].time_us - view.time_us))
            camera = log.camera(names[view.camera]).camera(view.index, sky.shape[1], sky.shape[0])
            sky = _unstruck(sky, points[nearest], camera)
        told.append(replace(view, sky=torch.from_numpy(sky) | view.sky if kind == "blinding" else torch.from_numpy(sky)))
    if float(np.mean([v.sky.float().mean() for v in told])) <= more * blue:
        return views, "blue"
    return told, kind


def _colourless(image: torch.Tensor) -> bool:
    return bool((image[..., 0] == image[..., 2]).all())


def _unstruck(sky: np.ndarray, points: np.ndarray, camera: Camera) -> np.ndarray:
    """A mask `[h, w]` without the columns in which lidar's `points` `[N, 3]`, as a camera of its size sees them, strike it."""
    row, column, _, inside = project(points, inverse(camera.world_from_cam).numpy(), camera)
    struck = np.zeros(sky.shape, np.float32)
    struck[row[inside], column[inside]] = 1
    # what is above all beams but some stray ones they do not tell
    reached = np.arange(len(sky))[:, None] >= (np.quantile(row[inside], STRAY) if inside.any() else len(sky))
    hits, cells = (ndimage.uniform_filter1d(m.sum(0, dtype=np.float32), AROUND) for m in (struck * sky * reached, sky & reached))
    return sky & (hits <= STRUCK * cells)


def coarse_sky(image: torch.Tensor, ego: torch.Tensor | None, kind: SkyKind = "blue") -> torch.Tensor:
    """The sky of an image on a grid about 240 cells wide: without its rim, but for what of that looks like it, where splats of its colour
    would stand before walls as soon as it is seen from elsewhere. Nothing of it is in the recording car."""
    step = max(1, image.shape[1] // 240)
    coarse = np.ascontiguousarray(image[step // 2 :: step, step // 2 :: step].numpy())
    found = torch.from_numpy(like_sky(coarse, ndimage.binary_erosion(sky_mask(coarse, kind), border_value=1), RIM))
    return found if ego is None else found & ~ego[step // 2 :: step, step // 2 :: step]
