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

Proven in the mean, for splats that lie about independently of each other:

- Cutoff. Of a splat's alpha a share of exp(-s) lies beyond exponent s, since the area of a Gaussian's level sets grows as s. The cutoff
  c = e/64, or c o / FAINT for a splat whose opacity o is below FAINT, so leaves out a share of c / FAINT at most of what each splat
  stops, hence of the optical depth in front of any point. Then transmittance t = exp(-tau) is off by tau exp(-tau) c / FAINT, at most
  0.37 * 4 c = 0.03 e. Without FAINT it would grow without limit: a fog of splats that are all below the cutoff would vanish.

Not bounded: splats that stand in one line of sight each leave out up to c of the same pixel. A hundred in a stack are 1.5 e off and four
hundred 6 e; a wall of thousands along a street, seen edge on, 1.4 to 2.7 e. A bound would take a cutoff of e / 8n in tiles of n entries.

Measured, since splats do not lie independently: beside a dense wall many tails fall on one pixel at once; and float32's rounding of the
ellipses, 1e-5 of a colour. Over the 200 random scenes and the presets of `tests/render/test_budget.py` the largest error of a pixel is
0.1 e on random scenes and 0.3 e on the whole drive at 64x36, where 43 splats share a pixel.
"""

from __future__ import annotations

FAINT = 0.25
"""Opacity below which a splat's cutoff shrinks with it, where a budget is set."""


def split(max_error: float) -> dict[str, float | str]:
    """The shortcuts' limits that keep `max_error`, as fields of a RenderConfig; ValueError for what float32 cannot keep."""
    if not 1e-4 <= max_error < 1:
        raise ValueError(f"max_error must be at least 1e-4, which float32 can keep, and below 1, got {max_error}")
    return {"alpha_cutoff": max_error / 64, "alpha_max": 1 - max_error / 16, "termination": max_error / 8, "faint": FAINT, "order": "pixel"}
