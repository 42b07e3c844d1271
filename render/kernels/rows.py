"""What kernels on lane vectors share: comparison and exp without branches or calls, and the rows of a tile that an ellipse reaches."""

import warp as wp

from render.kernels.types import INV_C, OPTIONS, S_MAX, SLACK, TILE, Y_EXT, H, K, M, X, Y, lanes

LAST = wp.constant(TILE - 1)
WIDTH = wp.constant(float(TILE - 1))
ROLLED = OPTIONS | {"max_unroll": 8}  # loops over a tile's 16 rows stay loops: unrolled they compile ten times as long and run no faster


@wp.func
def below(limit: float, z: lanes):
    """1 where z < limit, else 0 (limit of ordinary size, z of any)."""
    return wp.min(wp.max(lanes(limit * 1.0e30) - z * 1.0e30, lanes(0.0)), lanes(1.0))


@wp.func
def before(place: float, places: lanes):
    """Those of `places`, whole numbers, that are less than `place`; -1 for the others."""
    less = wp.min(wp.max(lanes(place) - places, lanes(0.0)), lanes(1.0))
    return wp.cw_mul(less, places + lanes(1.0)) - lanes(1.0)


@wp.func
def exp_series(z: lanes):
    """exp(-z) for z in [0, 0.75]: Taylor to degree 6, relative error 2e-5 at the end."""
    tail = lanes(0.041666668) - wp.cw_mul(z, lanes(0.008333334) - z * 0.00138889)
    return lanes(1.0) - z + wp.cw_mul(wp.cw_mul(z, z), lanes(0.5) - wp.cw_mul(z, lanes(0.16666667) - wp.cw_mul(z, tail)))


@wp.func
def lesser(a: float, b: float):
    """Half the instructions of `wp.min`, which minds NaN."""
    return wp.where(a < b, a, b)


@wp.func
def greater(a: float, b: float):
    return wp.where(a > b, a, b)


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
