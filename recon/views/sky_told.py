"""Which cells of a drive's views show the sky, whatever it looks like: told by where nothing stands, and by how it looks there.

Where lidar strikes something, or pictures find points, is no sky; above all of that it may be. Together these teach how a camera's sky
looks and how its street does, in colour and in grain: a white wall under a white sky looks like what is struck, an orange cloud like
nothing that is. Where geometry is silent, looks decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from scipy import ndimage

from recon.log import Log, SparsePoints
from recon.views.ceilings import MOST, without_ceilings
from recon.views.project import project
from recon.views.skies import closed, even, like_sky, reaching_top, sky_mask
from recon.views.view import View
from render.rays import world_directions
from scenes.poses import inverse
from scenes.spread import spread

RIM = 6
"""Cells, of about 240 across an image, by which what looks like the sky beside it may reach into its rim."""

SWEEPS, SHOWN = 3, 16
"""Sweeps nearest to a view's moment that tell what stands there; and of how many pictures before it and after the points do."""

STRAY, AROUND = 0.005, 9
"""Part of a sweep's points in a picture that may lie above where its beams go in general; and cells across within which they strike what
stands there. What is struck alone in so many is no thing either, but chance."""

SIDE, BELOW = 4, 4
"""Cells to either side, and above what is struck there, from which on nothing need stand."""

UP = 0.01
"""Sine of the elevation from which on there may be sky."""

TOLD = 300
"""Cells of the street above the horizon, and of the open above it, that a camera's views must have to teach how both look."""

LIGHTNESS, COLOUR, GRAIN = 32, 32, 5
"""Bins by which looks are counted."""

ASKED = 8
"""Sweeps, or views, that tell how far away what stands is."""

DARK = 12.0
"""Levels about which differences count by levels no more, but by parts."""

AT_MOST, SURE = 4.0, 3.0
"""How much the look of a cell tells, as a natural logarithm of odds, and odds from which on it is sky."""

NOTHING_STRUCK, BLUE = 4.5, 1.0
"""What is added to them where beams go and strike nothing, and in smooth blue that reaches the picture's top."""


@dataclass(frozen=True)
class Cells:
    """A view on its coarse grid: `image` uint8 `[h, w, 3]`; bool `[h, w]`: `struck` something, `beams` go there, `above` the horizon;
    `look` of each, as a number."""

    image: np.ndarray
    struck: np.ndarray
    beams: np.ndarray
    above: np.ndarray
    look: np.ndarray


def under_their_sky(log: Log, names: Sequence[str], views: list[View], points: SparsePoints | None = None) -> list[View]:
    """The views with their skies as lidar, or without it the `points` that pictures showed, tell them; as they are where neither tells
    enough of a camera's views, and smooth blue is all that is known of sky."""
    told = dict(zip(range(len(views)), views, strict=True))
    cells, far = _cells(log, names, views, points), _farthest(log, names, views, points)
    for camera in range(len(names)):
        mine = [i for i in cells if views[i].camera == camera]
        odds = _taught([cells[i] for i in mine if not views[i].held_out])
        if odds is None:
            continue
        for i in mine:
            sky = torch.from_numpy(_sky(cells[i], odds))
            ego = views[i].ego
            told[i] = replace(views[i], sky=sky if ego is None else sky & ~_coarse(ego, sky.shape))
    return without_ceilings(log, names, list(told.values()), far)


def _farthest(log: Log, names: Sequence[str], views: list[View], points: SparsePoints | None) -> float:
    """Metres from the cameras, or the lidars, within which `MOST` of what stands is; infinite where nothing tells."""
    sweeps = spread(log.sweeps_within((min(v.time_us for v in views), max(v.time_us for v in views))), ASKED)
    if sweeps:
        away = [np.linalg.norm(s.read().xyz - log.ego.near(s.time_us)[:3, 3].numpy(), axis=1) for s in sweeps]
    elif points is not None:
        shown = [(log.camera(names[v.camera]).world_from_cam[v.index, :3, 3].numpy(), points.seen[names[v.camera]][v.index]) for v in views]
        away = [np.linalg.norm(points.xyz[which] - eye, axis=1) for eye, which in spread(shown, ASKED)]
    else:
        return np.inf
    all_of_it = np.concatenate([np.zeros(0), *away])
    return float(np.quantile(all_of_it, MOST)) if len(all_of_it) else np.inf


def coarse_sky(image: torch.Tensor, ego: torch.Tensor | None) -> torch.Tensor:
    """The blue sky of an image on a grid about 240 cells wide: without its rim, but for what of that looks like it, where splats of its
    colour would stand before walls as soon as it is seen from elsewhere. Nothing of it is in the recording car."""
    coarse = _small(image)
    found = torch.from_numpy(_with_rim(coarse, sky_mask(coarse)))
    return found if ego is None else found & ~_coarse(ego, found.shape)


def _small(image: torch.Tensor) -> np.ndarray:
    step = max(1, image.shape[1] // 240)
    return np.ascontiguousarray(image[step // 2 :: step, step // 2 :: step].numpy())


def _coarse(mask: torch.Tensor, shape: Sequence[int]) -> torch.Tensor:
    step = max(1, mask.shape[1] // 240)
    return mask[step // 2 :: step, step // 2 :: step][: shape[0], : shape[1]]


def _with_rim(image: np.ndarray, sky: np.ndarray) -> np.ndarray:
    return like_sky(image, ndimage.binary_erosion(sky, border_value=1), RIM)


def _cells(log: Log, names: Sequence[str], views: list[View], points: SparsePoints | None) -> dict[int, Cells]:
    """By the views' places in their list; none where nothing tells what stands there."""
    sweeps = log.sweeps_within((min(v.time_us for v in views), max(v.time_us for v in views)))
    if not sweeps and points is None:
        return {}

    @lru_cache(2 * SWEEPS)
    def xyz(k: int) -> np.ndarray:
        return sweeps[k].read().xyz

    found = {}
    for i in sorted(range(len(views)), key=lambda i: views[i].time_us):  # a sweep is read once for all cameras
        view, image = views[i], _small(views[i].image)
        if sweeps:
            near = sorted(range(len(sweeps)), key=lambda k: abs(sweeps[k].time_us - view.time_us))[:SWEEPS]
            standing = np.concatenate([xyz(k) for k in near])
        else:
            assert points is not None
            seen = points.seen[names[view.camera]][max(0, view.index - SHOWN) : view.index + SHOWN + 1]
            standing = points.xyz[np.unique(np.concatenate(seen))]
        camera = log.camera(names[view.camera]).camera(view.index, image.shape[1], image.shape[0])
        row, column, _, inside = project(standing, inverse(camera.world_from_cam).numpy(), camera)
        struck = np.zeros(image.shape[:2], bool)
        struck[row[inside], column[inside]] = True
        struck &= _within(struck, AROUND) > 1.5
        beams = np.arange(len(image))[:, None] >= (np.quantile(row[inside], STRAY) if sweeps and inside.any() else len(image))
        above = world_directions(camera)[..., 2].numpy() > UP
        if view.ego is not None:
            above &= ~_coarse(view.ego, above.shape).numpy()
        found[i] = Cells(image, struck, np.broadcast_to(beams, struck.shape), above, _looks(image))
    return found


def _within(mask: np.ndarray, side: int) -> np.ndarray:
    """How many of a square about each cell there are."""
    return ndimage.uniform_filter(mask.astype(np.float32), side, mode="constant") * side**2


def _looks(image: np.ndarray) -> np.ndarray:
    """How each cell looks: a number of its lightness, two of colour, and how coarse its surroundings are, int64 `[h, w]`."""
    light = np.log1p(ndimage.uniform_filter(image.astype(np.float32), (3, 3, 1)) / DARK)
    warm = light[..., 0] - light[..., 2]
    green = light[..., 1] - (light[..., 0] + light[..., 2]) / 2
    own = image.astype(np.float32).mean(-1)
    mean = ndimage.uniform_filter(own, 7)
    grain = np.sqrt(np.maximum(ndimage.uniform_filter(own**2, 7) - mean**2, 0)) / (mean + DARK)
    parts = (
        (light.mean(-1) / np.log1p(256 / DARK), LIGHTNESS),
        (warm / 1.6 + 0.5, COLOUR),
        (green / 0.8 + 0.5, COLOUR),
        (np.log2(grain + 1e-6) / 7 + 1, GRAIN),
    )
    number = np.zeros(own.shape, np.int64)
    for value, bins in parts:
        number = number * bins + np.clip(value * bins, 0, bins - 1).astype(np.int64)
    return number


def _taught(views: Sequence[Cells]) -> np.ndarray | None:
    """Odds of each look to be sky, as logarithms; None where there is too little of sky or street."""
    street = [ndimage.binary_dilation(v.struck) & v.above for v in views]
    open_ = [_open(v) for v in views]
    if min(sum(int(m.sum()) for m in masks) for masks in (street, open_)) < TOLD:
        return None
    of_street, odds = _share(views, street), None
    for _ in range(3):
        # what is open may still be a house above the beams, or without features: it looks like others that are struck
        sky = open_ if odds is None else [m & (_void(v) | (odds[v.look] > 0)) for m, v in zip(open_, views, strict=True)]
        odds = np.log((_share(views, sky) + 1e-7) / (of_street + 1e-7))
    return odds


def _open(view: Cells) -> np.ndarray:
    """Cells above all that is struck in their column and beside it."""
    first = np.where(view.struck.any(0), view.struck.argmax(0), len(view.struck))
    highest = ndimage.minimum_filter1d(first, 2 * SIDE + 1)
    return (np.arange(len(view.struck))[:, None] < highest - BELOW) & view.above


def _void(view: Cells) -> np.ndarray:
    """Cells where beams go and strike nothing, and those above: what ends below where beams end does not go on above them."""
    void = view.beams & (_within(view.struck, AROUND) < 0.5)
    open_ = _open(view)
    return void | (open_ & (void & open_).any(0))


def _share(views: Sequence[Cells], masks: Sequence[np.ndarray]) -> np.ndarray:
    """Which part of the masked cells has each look, neighbouring looks counted in."""
    shape = LIGHTNESS, COLOUR, COLOUR, GRAIN
    count = sum(np.bincount(v.look[m], minlength=int(np.prod(shape))) for v, m in zip(views, masks, strict=True))
    smooth = ndimage.gaussian_filter(np.asarray(count, np.float64).reshape(shape), (0.7, 0.7, 0.7, 0.5)).ravel()
    return smooth / max(smooth.sum(), 1)


def _sky(view: Cells, odds: np.ndarray) -> np.ndarray:
    """Which cells are surely sky: joined to the picture's top, through what is even where no beams go."""
    void = _void(view)
    own = np.clip(odds[view.look], -AT_MOST, AT_MOST) + NOTHING_STRUCK * void + BLUE * sky_mask(view.image)
    own = np.where(ndimage.binary_dilation(view.struck), -AT_MOST, own)
    grey = ndimage.uniform_filter(view.image.astype(np.float32), (3, 3, 1)).mean(-1)
    own = _guided(own, np.log1p(grey / DARK))
    sky = closed(reaching_top((own > SURE) & view.above & (void | even(grey)))) & (own > 0)
    return _with_rim(view.image, sky) & view.above & ~view.struck


def _guided(value: np.ndarray, guide: np.ndarray, side: int = 7, least: float = 0.003) -> np.ndarray:
    """A value smoothed along a guide, not across its edges (He et al. 2010)."""
    mean, of_guide = ndimage.uniform_filter(value, side), ndimage.uniform_filter(guide, side)
    slope = ndimage.uniform_filter(guide * value, side) - of_guide * mean
    slope /= ndimage.uniform_filter(guide**2, side) - of_guide**2 + least
    return ndimage.uniform_filter(slope, side) * guide + ndimage.uniform_filter(mean - slope * of_guide, side)
