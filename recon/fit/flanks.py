"""The sides of a vehicle that pictures show from its rear or front alone, as of the one that the recording car follows all the way.

From two metres aside it is a shell: the street shows where its side should be, and what little is known of that, a wing mirror, hangs
beside it. So the outline of the end that is known is drawn along the vehicle's length, in the middle colour that the end has at each
height: paint, glass and bumper go round the corner, lamps and a plate do not. A guess, as mirror images are (`halves.py`).
"""

from __future__ import annotations

import math

import numpy as np
import torch

from recon.objects.mirror import FEWEST, SOLID
from recon.objects.outline import outline
from recon.seeds.points import alike
from scenes.gaussians import Gaussians
from scenes.harmonics import rgb_from_sh
from scenes.poses import matrix_from_quat

END = 1.0
"""Metres from the front or rear within which a splat is of that end."""

ALONG, UP = 0.4, 0.1
"""Metres between the splats of a side, along it and upwards."""

WIDE, THICK, LOGIT = 0.6, 0.02, 3.0
"""Their standard deviations along these two, in what is between them, and in metres across; the logit of their opacity."""

INSET = 0.1
"""Metres inside the outline at which a side is drawn: on it, pictures taken from behind would show it around the rear's blurred rim."""

THERE, OPEN = 0.8, 0.3
"""Opacity from aside of what is known further out than that, from which on a side is there: what pictures from behind show deep within a
rear is none of it, nor are specks. And the part of it that is not there from which on the rest is made."""

BONNET, BONNETED = ((0.6, 1.0), (0.28, 0.05)), {"car", "pickup", "vehicle"}
"""Parts of the height, and how far ahead of the middle vehicles reach there, in lengths, of those classes that end in a bonnet."""

WIDTH = 0.03
"""Metres by which a splat is taken to be wider than it is, as a picture from some metres aside shows it."""

COLUMN = 0.1
"""Metres of an end's width, each of which counts once in the colour of a height, however many splats it has."""


def flanks(known: Gaussians, size: np.ndarray, label: str) -> Gaussians:
    """Splats for what is not `known` of those sides of a vehicle in a box `[length, width, height]` of which more than `OPEN` is not, by
    its rear or front, whichever more is known of; none where neither is."""
    solid = known.select(torch.sigmoid(known.logit_opacities) > SOLID)
    means, colours = solid.means.double().cpu().numpy(), rgb_from_sh(solid.sh[:, 0]).double().cpu().numpy()
    at_ends = {end: means[:, 0] * end > size[0] / 2 - END for end in (1.0, -1.0)}
    end = max(at_ends, key=lambda end: int(at_ends[end].sum()))
    shape = outline(means[means[:, 0] * end > 0] * [end, 1, 1], size)
    if shape is None or at_ends[end].sum() < FEWEST:
        return Gaussians.empty(known.sh.shape[1])
    places, rgb = [], []
    for z in np.arange(shape[0][0], shape[0][-1], UP):
        ahead, half = (float(np.interp(z, shape[0], reach)) for reach in shape[1:])
        first, last = ahead - WIDE * ALONG, WIDE * ALONG - _other_end(z / size[2], end, label) * size[0]
        x = np.linspace(first, last, max(0, math.ceil((first - last) / ALONG) + 1))
        places.append(np.stack([x * end, np.full(len(x), half - INSET), np.full(len(x), z)], 1))
        rgb.append(np.tile(_middle_colour(means, colours, z, at_ends[end]), (len(x), 1)))
    left, colour, made = np.concatenate(places), np.concatenate(rgb), []
    for side in (1.0, -1.0):
        outer = means[:, 1] * side > np.interp(means[:, 2], shape[0], shape[2]) - INSET
        lacking = _opacity_from_aside(solid.select(torch.from_numpy(outer)), left[:, [0, 2]]) < THERE
        if len(left) and lacking.mean() > OPEN:
            made.append(alike(left[lacking] * [1, side, 1], colour[lacking], (WIDE * ALONG, THICK, WIDE * UP), LOGIT, known.sh.shape[1]))
    return Gaussians.cat(made) if made else Gaussians.empty(known.sh.shape[1])


def _opacity_from_aside(splats: Gaussians, at: np.ndarray) -> np.ndarray:
    """What `splats` of a vehicle hide `[N]` from far aside, along y, at places (x, z) `at` `[N, 2]`."""
    means, logits = (x.double().cpu() for x in (splats.means, splats.logit_opacities))
    axes = (matrix_from_quat(splats.quats) * splats.log_scales.exp()[:, None]).double().cpu()[:, [0, 2]]
    whitening = torch.linalg.inv(torch.linalg.cholesky(axes @ axes.mT + WIDTH**2 * torch.eye(2)))
    off = torch.from_numpy(at)[:, None] - means[:, [0, 2]]
    squares = torch.einsum("nij,pnj->pni", whitening, off).square().sum(-1)
    return (1 - (1 - torch.sigmoid(logits) * (-squares / 2).exp()).prod(1)).numpy()


def _other_end(height: float, end: float, label: str) -> float:
    """How far beyond its middle a vehicle reaches, in lengths, at its other end, at a part of its height."""
    bonnet = end < 0 and label in BONNETED and height > BONNET[0][0]
    return float(np.interp(height, *BONNET)) if bonnet else 0.5


def _middle_colour(means: np.ndarray, colours: np.ndarray, z: float, at_end: np.ndarray) -> np.ndarray:
    """The median over an end's columns of the colour `[3]` that splats have about a height: of those nearest to it."""
    near = at_end & (np.abs(means[:, 2] - z) <= max(UP, np.abs(means[at_end, 2] - z).min()))
    _, column = np.unique(np.round(means[near, 1] / COLUMN), return_inverse=True)
    total = np.stack([np.bincount(column, colours[near, k]) for k in range(3)], 1)
    return np.median(total / np.bincount(column)[:, None], axis=0)
