"""Bands of spherical harmonics that are zero for every splat of a set are neither read nor evaluated.

Splats made from meshes or points have none but the first; trained ones may end below the degree that their file stores. Looked at once for
a set of splats and kept beside it. Only where nothing is differentiated: a zero band has a gradient.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from render.kept import kept_beside
from scenes.gaussians import SH_COUNTS, Gaussians


def without_zero_bands(g: Gaussians) -> Gaussians:
    """The same splats with no more SH coefficients than say something; `g` itself where all do."""
    if g.sh.shape[1] == 1 or not len(g):
        return g
    said = _bands_that_say_something(g.sh)
    return g if said is None else replace(g, sh=said)


@kept_beside
def _bands_that_say_something(sh: torch.Tensor) -> torch.Tensor | None:
    """None where all do."""
    used = sh.detach().ne(0).any(0).any(1)  # NaN is not zero
    last = int(used.nonzero().max()) if used.any() else 0
    count = next(c for c in SH_COUNTS if c > last)
    return None if count == sh.shape[1] else sh.detach()[:, :count].contiguous()
