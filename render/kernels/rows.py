"""What kernels on lane vectors share: exp without branches or calls, and the rows of a tile that an ellipse reaches."""

from functools import cache

import warp as wp

from render.kernels.lanewise import cut, greater, greatest, lesser
from render.kernels.types import INV_C, OPTIONS, S_MAX, SLACK, TILE, Y_EXT, H, K, M, X, Y, lanes

LAST = wp.constant(TILE - 1)
WIDTH = wp.constant(float(TILE - 1))
ROUNDING = wp.constant(1.00001)
EXP = (-0.9999987248495342, 0.49995871443426915, -0.16628684606491032, 0.04027258706981761, -0.006117409069963007)
ROLLED = OPTIONS | {"max_unroll": 8}  # loops over a tile's 16 rows stay loops: unrolled they compile ten times as long and run no faster


@cache
def exp_of(squarings: int):
    """The function exp(-s) of lanes: a polynomial of s / 2^squarings, squared that often; s / 2^squarings should lie in [0, 0.75], beyond
    it gives anything but negative numbers. 3 squarings serve cutoffs down to 1/400, 5 to 1e-10.

    The polynomial is minimax for its 8th power, with 1 at 0: off by 5e-7 at most, and by 6e-6 of itself; 5 squarings, by 2e-6 and 3e-5
    (`python -m tests.bench.accuracy`).
    """
    c1, c2, c3, c4, c5 = (c * 0.5 ** (squarings * (k + 1)) for k, c in enumerate(EXP))

    @wp.func
    def exp_minus(s: lanes):
        p = lanes(wp.static(c4)) + s * wp.static(c5)
        p = lanes(wp.static(c3)) + wp.cw_mul(s, p)
        p = lanes(wp.static(c2)) + wp.cw_mul(s, p)
        p = lanes(wp.static(c1)) + wp.cw_mul(s, p)
        p = lanes(1.0) + wp.cw_mul(s, p)
        for _q in range(wp.static(squarings)):
            p = wp.cw_mul(p, p)
        return p

    return exp_minus


@wp.func
def row_range(record: lanes, x0: float, y0: float):
    """First and last row that the ellipse reaches within the columns of the tile whose first pixel centre is x0, y0."""
    px = record[X] - x0
    py = record[Y] - y0
    k = record[K]
    m = record[M]
    h = record[H]
    inv_c = record[INV_C]
    k2 = k * k
    cs = (k2 * m * m + h) * record[S_MAX]
    k2h = k2 * h
    slope = k2 * m * inv_c
    x_at_ext = m * record[Y_EXT]
    left = -px - SLACK
    right = WIDTH - px + SLACK
    dx_low = lesser(greater(x_at_ext, left), right)
    dx_high = lesser(greater(-x_at_ext, left), right)
    low = slope * dx_low + wp.sqrt(greater(cs - k2h * dx_low * dx_low, 0.0)) * inv_c + SLACK
    high = slope * dx_high - wp.sqrt(greater(cs - k2h * dx_high * dx_high, 0.0)) * inv_c - SLACK
    return wp.vec2i(wp.max(0, int(wp.ceil(py + high))), wp.min(LAST, int(wp.floor(py + low))))


@wp.func
def rows_met(record: lanes, x0: float, y0: float, rows: lanes, marks: lanes):
    """Of the tile whose first pixel centre is x0, y0, a lane a row: the exponent is (K column - ridge)^2 + across; and of marks those of
    the rows that the ellipse reaches."""
    dy = rows - lanes(record[Y] - y0)
    ridge = (lanes(record[X] - x0) + dy * record[M]) * record[K]
    across = wp.cw_mul(dy, dy) * record[H]
    beyond = greatest(ridge - lanes(record[K] * WIDTH), lanes(0.0) - ridge)
    # what rounding could do to a pixel's exponent must not drop its row
    return ridge, across, cut(wp.cw_mul(beyond, beyond) + across, record[S_MAX] * ROUNDING, marks)
