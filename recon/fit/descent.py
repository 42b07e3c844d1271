"""Adam over all splats at the cost of those in sight.

A splat that no picture pulls at still coasts on its momentum, ever slower. Those steps are left out and made up for at one go, in
closed form, when the splat comes into sight again: a step costs what it shows, and does what dense Adam does. The selective Adam of
Taming 3DGS (Mallick et al. 2024, section 4.3) leaves them out for good; that cost 0.7 dB here, since second moments that count only the
pictures that show a splat shorten the steps of those that few show.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
import warp as wp

from recon.fit.densify import LARGEST, LONGEST, THINNEST, Growth
from recon.fit.model import FIELDS, Splats
from recon.kernels.descent import BETA1, BETA2, Rates, catch_up, descend
from render.launch import run, stage, view

COLOURS = 11
"""The first of a splat's numbers, in the order of the fields, that is a colour's."""

_TYPES = (wp.vec3, wp.vec4, wp.vec3, float, wp.vec3)


class Descent:
    """moments `[N, 2, C]`: Adam's first and second, of each splat's C numbers; last `[N]`: the step, from 1, after which they are true."""

    def __init__(self, moments: torch.Tensor, last: torch.Tensor):
        self.moments, self.last = moments, last

    @staticmethod
    def begin(splats: Splats) -> Descent:
        count = sum(field[:1].numel() for field in splats.fields.values())
        device = splats.reach.device
        return Descent(torch.zeros(len(splats), 2, count, device=device), torch.zeros(len(splats), device=device))

    def tensors(self) -> dict[str, torch.Tensor]:
        return {"moments": self.moments, "last": self.last}

    def catch_up(self, splats: Splats, which: torch.Tensor, sh_count: int, rates: Rates) -> None:
        """Bring splats `which` `[M]` to where they are before the step `rates.now`."""
        with stage(which.device):
            args = [view(which, wp.int64), rates, sh_count, *_fields(splats), view(self.moments, float), view(self.last, float)]
            run(catch_up, len(which), args, which.device)

    def coloured(self) -> torch.Tensor:
        """At whose colours any picture has pulled: bool `[N]`."""
        return (self.moments[:, 1, COLOURS:] > 0).any(1)

    def still(self, which: torch.Tensor, first: int = 0) -> None:
        """Take their momentum from splats `which`, bool `[N]`, or from their numbers from `first` on, as `COLOURS`."""
        self.moments[which, 0, first:] = 0

    def follow(self, splats: Splats, which: torch.Tensor, shown: Splats, rates: Rates, growth: Growth) -> None:
        """Move splats `which` `[M]`, which have caught up, along the gradients of `shown`, copies of theirs, and tell `growth`."""
        gradients = [g.contiguous() for g in (shown.fields[name].grad for name in FIELDS) if g is not None]
        arrays = [view(g, kind) for g, kind in zip(gradients, _TYPES, strict=True)] + _fields(splats)
        arrays += [view(t, float) for t in (self.moments, self.last, growth.pull, growth.pulled)]
        with stage(which.device):
            run(descend, len(which), [view(which, wp.int64), rates, *arrays], which.device)


def rates_at(now: int, steps: Mapping[str, float], fade: float = 0.0) -> Rates:
    """What step `now`, from 1, does: `steps` a field, and "harmonics" for those of the colours beyond the first; `fade`: the logit that a
    splat loses each time it is seen."""
    rates = Rates()
    for name, length in steps.items():
        setattr(rates, name, length)
    rates.fade, rates.now, rates.unbias1, rates.unbias2 = fade, float(now), 1 / (1 - BETA1**now), 1 / (1 - BETA2**now)
    rates.log_largest, rates.log_thinnest, rates.log_longest = (math.log(x) for x in (LARGEST, THINNEST, LONGEST))
    return rates


def _fields(splats: Splats) -> list:
    """What both kernels read and write of the splats."""
    return [*(view(splats.fields[name], kind) for name, kind in zip(FIELDS, _TYPES, strict=True)), view(splats.reach, float)]
