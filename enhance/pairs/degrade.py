"""Splats made worse as an unfinished reconstruction is worse: fewer, larger, smoother, with colours not yet settled."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from scenes.gaussians import Gaussians
from scenes.scene import Scene


@dataclass(frozen=True)
class Underfit:
    """How unfinished: each number is 0 for a finished reconstruction.

    thin    share of splats left out; the rest grow to cover the gaps
    swell   growth of the scales in log units on top of that
    colour  spread of an error of the base colour, in SH units (0.282 of it is the change of sRGB)
    detail  share of the view-dependent colour taken away
    jitter  spread of an error of the centres, as a share of each splat's middle scale
    """

    thin: float = 0.0
    swell: float = 0.0
    colour: float = 0.0
    detail: float = 0.0
    jitter: float = 0.0

    def __post_init__(self):
        if not 0 <= self.thin < 1 or not 0 <= self.detail <= 1 or self.colour < 0 or self.jitter < 0:
            raise ValueError(f"thin must be in 0..1 (below 1), detail in 0..1, colour and jitter at least 0, got {self}")


def random_underfit(rng: np.random.Generator) -> Underfit:
    """Settings from nearly finished to a fifth of the splats."""
    much = rng.uniform(0.15, 1.0)
    return Underfit(
        thin=0.8 * much * rng.uniform(0.5, 1.0),
        swell=0.35 * much * rng.uniform(0, 1),
        colour=0.35 * much * rng.uniform(0, 1),
        detail=rng.uniform(0, 1),
        jitter=0.6 * much * rng.uniform(0, 1),
    )


def unfinish(scene: Scene, how: Underfit, seed: int) -> Scene:
    """The scene with every set of splats underfitted; the same seed gives the same scene, whatever the frame."""
    background = replace(scene.background, gaussians=_worse(scene.background.gaussians, how, seed))
    actors = [
        replace(actor, asset=replace(actor.asset, gaussians=_worse(actor.asset.gaussians, how, seed + 1 + i)))
        for i, actor in enumerate(scene.actors)
    ]
    return replace(scene, background=background, actors=tuple(actors))


def _worse(g: Gaussians, how: Underfit, seed: int) -> Gaussians:
    rng = torch.Generator().manual_seed(seed)
    keep = torch.rand(len(g.means), generator=rng) >= how.thin
    g = Gaussians(g.means[keep], g.quats[keep], g.log_scales[keep], g.logit_opacities[keep], g.sh[keep])
    n = len(g.means)
    # Thinning alone would leave holes that optimisation would have closed: areas grow by what was left out.
    grow = -0.5 * float(np.log(1 - how.thin)) + how.swell
    middle = g.log_scales.exp().median(-1, keepdim=True).values if n else g.log_scales[:, :1]
    means = g.means + how.jitter * middle * torch.randn(n, 3, generator=rng)
    sh = g.sh.clone()
    # One error for brightness and a smaller one a channel: what few steps leave behind is mostly brightness.
    sh[:, 0] += how.colour * (0.8 * torch.randn(n, 1, generator=rng) + 0.4 * torch.randn(n, 3, generator=rng))
    sh[:, 1:] *= 1 - how.detail
    return Gaussians(means, g.quats, g.log_scales + grow, g.logit_opacities, sh)
