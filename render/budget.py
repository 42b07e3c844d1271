"""One number for how far a picture may be from truth, split among the kernels' shortcuts.

Truth is the splat model in exact arithmetic: every ray's own order, no cutoff, no clamp, no termination (`tests/oracle.py: truth`).
The budget e is the largest error of a pixel's colour, in units of the brightest colour that a splat has, and of 1 at least.

Order: by pixel. By tile, splats that reach through each other stand wrongly over whole regions, 0.2 off and more, which no budget allows.
Two splats change places where truth does, since their places along a ray are found and compared in float64 (`kernels/ray_rows.py`): to
1e-11 of a depth, about which truth itself jumps. Places that are equal keep the order of the centres' depths, then of the list.

Proven, for every scene:

- Termination at transmittance e/8: all that lies behind changes the pixel by less than that light, so by e/8 at most. What lies behind is
  left out of the sort where so little passes the entries that are nearer than all of it (`lit` in `kernels/ray_rows.py`).
- Clamp at 1 - e/16: the first clamped splat lets e/16 too much through, the next e/16 of that, and so on: below e/15 together.
- exp by its polynomial (`kernels/rows.py`): off by 8e-7 of an opacity at most, at any argument (`tests/bench/accuracy.py`).
- Tiles in which no two splats can change places are drawn in the tile's order, by its faster kernel: interval arithmetic over the tile's
  rays shows that each splat's places end before the next one's begin (`kernels/settled.py`).
- Cutoff at c = e / 2n where n splats are drawn (`cutoff`), e/64 where they are few: should all of them stand in one line of sight, each
  leaving out c of the same pixel, they leave out e/2 together. (At e/64 for any number four hundred in a stack were 6 e off, and a wall of
  thousands along a street, seen edge on, 1.4 to 2.7 e.) Cutoffs end at 1e-10, so the bound at 5e9 e splats, 19 million at 1/255.

Together 0.7 e. Measured: float32's rounding of the ellipses, 1e-5 of a colour.
"""

from __future__ import annotations


def cutoff(max_error: float, splats: int) -> float:
    """Below which contributions of so many splats may be left out, should all of them be of one pixel."""
    return max_error / max(64, 2 * splats)


def split(max_error: float) -> dict[str, float | str]:
    """The shortcuts' limits that keep `max_error`, as fields of a RenderConfig; ValueError for what float32 cannot keep."""
    if not 1e-4 <= max_error < 1:
        raise ValueError(f"max_error must be at least 1e-4, which float32 can keep, and below 1, got {max_error}")
    return {
        "alpha_cutoff": cutoff(max_error, 0),
        "alpha_max": 1 - max_error / 16,
        "termination": max_error / 8,
        "order": "pixel",
    }
