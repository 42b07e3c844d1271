"""Cars, trucks and people are near enough symmetric about the xz plane of their box: what nobody saw of them looks as its mirror image."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from scipy.spatial import cKDTree

from scenes.gaussians import Gaussians
from scenes.harmonics import turned
from scenes.poses import matrix_from_quat

FLOOR = 0.06
"""Metres above the base of a box under which splats are road, not wheel."""

FAINT = 0.05
"""Opacity under which a splat is left behind."""

SOLID = 0.3
"""Opacity from which on a splat tells that something is where it is."""

THERE = 0.15
"""Metres from something solid within which nothing is added to it."""

FEWEST = 50
"""Solid splats from which on a vehicle has a side to be mirrored."""


def within_box(gaussians: Gaussians, size: torch.Tensor) -> Gaussians:
    """The splats of a box frame that belong to the object: inside, above the floor, not faint, and not sticking out of the box."""
    half = size[:2].float() / 2 + 0.08
    means, axes = gaussians.means, matrix_from_quat(gaussians.quats)
    # from the sides it was not seen from, a splat that the pictures drew out along their rays is a spike
    spread = 1.5 * (axes.square() * gaussians.log_scales.exp().square()[:, None]).sum(2).sqrt()
    keep = (means[:, :2].abs() <= half).all(1) & (means[:, 2] > FLOOR) & (means[:, 2] < float(size[2]) + 0.1)
    keep &= (means[:, :2].abs() + spread[:, :2] < half + 0.12).all(1)
    keep &= (means[:, 2] + spread[:, 2] < float(size[2]) + 0.15) & (means[:, 2] - spread[:, 2] > FLOOR - 0.15)
    keep &= torch.sigmoid(gaussians.logit_opacities) > FAINT
    keep &= gaussians.log_scales.amax(1) < math.log(float(size.min()) / 3)
    return gaussians.select(keep)


def mirrored(gaussians: Gaussians) -> Gaussians:
    """The mirror image of the splats of a box frame."""
    flip = torch.tensor([1.0, -1.0, 1.0], device=gaussians.means.device)
    mirror = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
    # of a mirrored rotation the axes x and z turn the other way round
    quats = gaussians.quats * torch.tensor([1.0, -1.0, 1.0, -1.0], device=gaussians.quats.device)
    return replace(gaussians, means=gaussians.means * flip, quats=quats, sh=turned(gaussians.sh, mirror))


def other_half(known: Gaussians, size: torch.Tensor) -> Gaussians:
    """The mirror image of what is known of a vehicle in a box `[length, width, height]`, where nothing that is known stands."""
    solid = known.means[torch.sigmoid(known.logit_opacities) > SOLID].double().cpu().numpy()
    if len(solid) < FEWEST:
        return Gaussians.empty(known.sh.shape[1])
    image = mirrored(within_box(known, size))
    away, _ = cKDTree(solid).query(image.means.double().cpu().numpy())
    return image.select(torch.from_numpy(away > THERE).to(image.means.device))
