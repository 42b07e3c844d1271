"""Bands of spherical harmonics that are zero for every splat of a set are neither read nor evaluated.

Splats made from meshes or points have none but the first; trained ones may end below the degree that their file stores. Looked at once for
a set of splats and kept beside it. Only where nothing is differentiated: a zero band has a gradient.
"""

from __future__ import annotations

from dataclasses import replace

from torch.utils.weak import WeakTensorKeyDictionary

from scenes.gaussians import SH_COUNTS, Gaussians

_kept = WeakTensorKeyDictionary()  # by sh: its version, and the bands that are not zero


def without_zero_bands(g: Gaussians) -> Gaussians:
    """The same splats with no more SH coefficients than say something; `g` itself where all do."""
    if g.sh.shape[1] == 1 or not len(g):
        return g
    kept = _kept.get(g.sh)
    if kept is None or kept[0] != g.sh._version:
        used = g.sh.detach().ne(0).any(0).any(1)  # NaN is not zero
        last = int(used.nonzero().max()) if used.any() else 0
        count = next(c for c in SH_COUNTS if c > last)
        kept = (g.sh._version, None if count == g.sh.shape[1] else g.sh.detach()[:, :count].contiguous())
        _kept[g.sh] = kept
    return g if kept[1] is None else replace(g, sh=kept[1])
