"""What kernels on lane vectors share: exp without branches or calls, and the rows of a tile that an ellipse reaches."""

from functools import cache

import warp as wp

from render.kernels.lanewise import cut, greater, greatest, lesser
from render.kernels.types import ALONG, DOWN, OPTIONS, S_MAX, SLACK, TILE, X_REST, Y_EXT, Y_REST, H, K, M, Window, X, Y, Z, lanes

LAST = wp.constant(TILE - 1)
WIDTH = wp.constant(float(TILE - 1))
ROUNDING = wp.constant(1.00001)
EXP = (
    -0.99999989594439, 0.4999973195795904, -0.1666446929074362, 0.041585101006979555, -0.008176347677892794, 0.0012246760256379365,
    -0.00010672455304457475,
)  # fmt: skip
ROLLED = OPTIONS | {"max_unroll": 8}  # loops over a tile's 16 rows stay loops: unrolled they compile ten times as long and run no faster


@cache
def exp_of(squarings: int):
    """The function exp(-s) of lanes: a polynomial of s / 2^squarings, squared that often; s / 2^squarings should lie in [0, 1.5], beyond
    it gives anything but negative numbers. 2 squarings serve cutoffs down to 1/400, 4 to 1e-10.

    Every squaring doubles the rounding, so a longer polynomial and fewer of them are as fast and err half as much. It is minimax for its
    4th power, with 1 at 0: off by 2e-7 at most, and by 3e-6 of itself; 4 squarings, by 8e-7 and 2e-5 (`python -m tests.bench.accuracy`).
    """
    c1, c2, c3, c4, c5, c6, c7 = (c * 0.5 ** (squarings * (k + 1)) for k, c in enumerate(EXP))

    @wp.func
    def exp_minus(s: lanes):
        p = lanes(wp.static(c6)) + s * wp.static(c7)
        p = lanes(wp.static(c5)) + wp.cw_mul(s, p)
        p = lanes(wp.static(c4)) + wp.cw_mul(s, p)
        p = lanes(wp.static(c3)) + wp.cw_mul(s, p)
        p = lanes(wp.static(c2)) + wp.cw_mul(s, p)
        p = lanes(wp.static(c1)) + wp.cw_mul(s, p)
        p = lanes(1.0) + wp.cw_mul(s, p)
        for _q in range(wp.static(squarings)):
            p = wp.cw_mul(p, p)
        return p

    return exp_minus


@wp.func
def corner_of(window: Window, tile: int):
    """Where a window's tile begins: its column of tiles and its first row in the planes, and the first pixel's centre in the image."""
    tx = tile % window.tiles_x
    ty = tile // window.tiles_x
    return tx, ty * TILE, float((window.left + tx) * TILE) + 0.5, float((window.top + ty) * TILE) + 0.5


@wp.func
def from_corner(slope: wp.vec2, record: lanes, x0: float, y0: float):
    """A splat's slopes, and its depth at the tile's first pixel centre x0, y0."""
    return wp.vec3(slope[ALONG], slope[DOWN], record[Z] + slope[ALONG] * (x0 - record[X]) + slope[DOWN] * (y0 - record[Y]))


@wp.func
def depth_along(corner: wp.vec3, column: lanes, row: int):
    """A splat's depth at a row's pixels; corner: as of `from_corner`."""
    return lanes(corner[2] + float(row) * corner[DOWN]) + column * corner[ALONG]


@wp.func
def row_range(record: lanes, x0: float, y0: float):
    """First and last row that the ellipse reaches within the columns of the tile whose first pixel centre is x0, y0."""
    px = record[X] - x0
    py = record[Y] - y0
    k = record[K]
    m = record[M]
    h = record[H]
    k2 = k * k
    c = k2 * m * m + h
    inv_c = 1.0 / c
    cs = c * record[S_MAX]
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
    dy = rows - lanes((record[Y] - y0) + record[Y_REST])
    ridge = (lanes((record[X] - x0) + record[X_REST]) + dy * record[M]) * record[K]
    across = wp.cw_mul(dy, dy) * record[H]
    beyond = greatest(ridge - lanes(record[K] * WIDTH), lanes(0.0) - ridge)
    # what rounding could do to a pixel's exponent must not drop its row
    return ridge, across, cut(wp.cw_mul(beyond, beyond) + across, record[S_MAX] * ROUNDING, marks)
