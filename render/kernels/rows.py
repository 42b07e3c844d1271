"""What kernels on lane vectors share: comparison and exp without branches or calls, and the rows of a tile that an ellipse reaches."""

from functools import cache

import warp as wp

from render.kernels.types import INV_C, OPTIONS, S_MAX, SLACK, TILE, Y_EXT, H, K, M, X, Y, lanes

LAST = wp.constant(TILE - 1)
WIDTH = wp.constant(float(TILE - 1))
EXP = (-0.9999987248495342, 0.49995871443426915, -0.16628684606491032, 0.04027258706981761, -0.006117409069963007)
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


@cache
def exp_of(squarings: int):
    """The function exp(-s) of lanes: a polynomial of s / 2^squarings, squared that often; s / 2^squarings should lie in [0, 0.75], beyond
    it gives anything but negative numbers. 3 squarings serve cutoffs down to 1/400, 5 to 1e-10.

    The polynomial is minimax for its 8th power, with 1 at 0: off by 2e-7 at most, and by 1e-5 of itself; 5 squarings, by 3e-7 and 2e-5
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


@wp.func
def shown(s: lanes, s_max: float, full: lanes, alpha_max: float):
    """The splat's alpha: `full`, at most alpha_max, where s < s_max; else 0. Written out, it becomes one comparison and one minimum."""
    return lanes(
        wp.where(s[0] < s_max, lesser(full[0], alpha_max), 0.0), wp.where(s[1] < s_max, lesser(full[1], alpha_max), 0.0), wp.where(s[2] < s_max, lesser(full[2], alpha_max), 0.0), wp.where(s[3] < s_max, lesser(full[3], alpha_max), 0.0),
        wp.where(s[4] < s_max, lesser(full[4], alpha_max), 0.0), wp.where(s[5] < s_max, lesser(full[5], alpha_max), 0.0), wp.where(s[6] < s_max, lesser(full[6], alpha_max), 0.0), wp.where(s[7] < s_max, lesser(full[7], alpha_max), 0.0),
        wp.where(s[8] < s_max, lesser(full[8], alpha_max), 0.0), wp.where(s[9] < s_max, lesser(full[9], alpha_max), 0.0), wp.where(s[10] < s_max, lesser(full[10], alpha_max), 0.0), wp.where(s[11] < s_max, lesser(full[11], alpha_max), 0.0),
        wp.where(s[12] < s_max, lesser(full[12], alpha_max), 0.0), wp.where(s[13] < s_max, lesser(full[13], alpha_max), 0.0), wp.where(s[14] < s_max, lesser(full[14], alpha_max), 0.0), wp.where(s[15] < s_max, lesser(full[15], alpha_max), 0.0),
    )  # fmt: skip


@wp.func
def farther(a: lanes, b: lanes):
    """The greater of both, or 0 where neither is positive."""
    return lanes(
        greater(greater(a[0], b[0]), 0.0), greater(greater(a[1], b[1]), 0.0), greater(greater(a[2], b[2]), 0.0), greater(greater(a[3], b[3]), 0.0),
        greater(greater(a[4], b[4]), 0.0), greater(greater(a[5], b[5]), 0.0), greater(greater(a[6], b[6]), 0.0), greater(greater(a[7], b[7]), 0.0),
        greater(greater(a[8], b[8]), 0.0), greater(greater(a[9], b[9]), 0.0), greater(greater(a[10], b[10]), 0.0), greater(greater(a[11], b[11]), 0.0),
        greater(greater(a[12], b[12]), 0.0), greater(greater(a[13], b[13]), 0.0), greater(greater(a[14], b[14]), 0.0), greater(greater(a[15], b[15]), 0.0),
    )  # fmt: skip


@wp.func
def largest(v: lanes):
    """The largest of numbers that are not negative, by halves; `wp.max` goes through them one by one."""
    a = greater(greater(greater(v[0], v[8]), greater(v[4], v[12])), greater(greater(v[2], v[10]), greater(v[6], v[14])))
    b = greater(greater(greater(v[1], v[9]), greater(v[5], v[13])), greater(greater(v[3], v[11]), greater(v[7], v[15])))
    return greater(a, b)
