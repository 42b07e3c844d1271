"""Whether a vehicle faces backwards: its red lamps are behind."""

from __future__ import annotations

import torch

from scenes.asset import Asset
from scenes.harmonics import rgb_from_sh
from scenes.names import slug

VEHICLES = ("car", "pickup", "van", "truck", "bus")
"""Classes of which all have such lamps."""

ENDS, HEIGHTS = 0.15, (0.25, 0.85)
"""Of a length, what counts as either end; and between which parts of a height lamps are."""

RED, TWICE = 0.25, 2.0
"""How much red there is, at least, in what is red, and times green and blue."""

LAMPS, ALONE, PAINTED = 0.01, 5.0, 0.05
"""Part of an end that its lamps are, at least; how many times as much that is as of the other end; and part of what is between both, from
which on the vehicle itself is red."""

SEEN = 100
"""Splats at an end, at least."""


def backwards(asset: Asset) -> bool:
    """Whether an asset is a vehicle that has red lamps in front, and none behind."""
    splats = asset.gaussians
    if slug(asset.label) not in VEHICLES:
        return False
    along = splats.means[:, 0] / asset.size[0].to(splats.means) + 0.5
    high = splats.means[:, 2] / asset.size[2].to(splats.means)
    shown = (torch.sigmoid(splats.logit_opacities) > 0.3) & (high > HEIGHTS[0]) & (high < HEIGHTS[1])
    red, *others = rgb_from_sh(splats.sh[:, 0]).T
    is_red = (red > RED) & (red > TWICE * torch.maximum(*others))
    behind, front = shown & (along < ENDS), shown & (along > 1 - ENDS)
    middle = shown & ~behind & ~front
    if min(int(end.sum()) for end in (behind, front, middle)) < SEEN:
        return False
    parts = [float(is_red[part].float().mean()) for part in (behind, middle, front)]
    return parts[2] > max(LAMPS, ALONE * parts[0]) and parts[1] < PAINTED
