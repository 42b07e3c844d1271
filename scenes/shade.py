"""The shade that a recorded mover brings along: splats of one dark colour on the ground, under its box and around it.

They are laid and held by the fit (recon/seeds/shade.py); what they are made of is known here, since who draws the mover has to know
that it needs no other shadow.
"""

from __future__ import annotations

from scenes.asset import Asset
from scenes.harmonics import sh_from_rgb

BLACK = 0.02
"""The colour of shade."""

EXACT = 1e-2
"""Of a coefficient: half precision rounds it."""

FEWEST = 8
"""Splats beside a box that are shade: of anything else hardly one has this colour there."""


def has_shade(asset: Asset) -> bool:
    """Whether an asset's splats hold the light that it keeps from the ground. One that was cut out of a scene has none."""
    splats = asset.gaussians
    beside = (splats.means[:, :2].abs() > asset.size[:2].to(splats.means) / 2).any(1)
    black = ((splats.sh[:, 0] - sh_from_rgb(BLACK)).abs() < EXACT).all(1)
    return int((beside & black).sum()) >= FEWEST
