"""What of an equirectangular picture a direction looks at."""

import warp as wp

from render.kernels.types import OPTIONS

wp.set_module_options(OPTIONS)

PI = wp.constant(3.14159265358979)


@wp.func
def place(d: wp.vec3, rows: int):
    """Column and row of a picture `[rows, 2 rows]`, pixels' edges whole."""
    column = (0.5 - wp.atan2(d[1], d[0]) / (2.0 * PI)) * float(2 * rows)
    row = (0.5 - wp.atan2(d[2], wp.sqrt(d[0] * d[0] + d[1] * d[1])) / PI) * float(rows)
    return wp.vec2(column, row)


@wp.kernel
def find_corners(
    directions: wp.array[wp.vec3], rows: int, places: wp.array2d[wp.int64], shares: wp.array2d[float],
    first: int,
):  # fmt: skip
    """The four pixels, of those of a picture `[rows, 2 rows]` one after the other, between whose middles each direction looks, and how
    much of each it sees: as `scenes.sky.sample_equirect` does."""
    i = first + wp.tid()
    at = place(directions[i], rows) - wp.vec2(0.5, 0.5)
    row = wp.clamp(at[1], 0.0, float(rows - 1))
    left = wp.floor(at[0])
    top = wp.min(wp.floor(row), float(wp.max(rows - 2, 0)))
    c0 = (int(left) + 2 * rows) % (2 * rows)
    c1 = (c0 + 1) % (2 * rows)
    r0 = int(top)
    r1 = wp.min(r0 + 1, rows - 1)
    for k in range(4):
        r = wp.where(k < 2, r0, r1)
        c = wp.where(k % 2 == 0, c0, c1)
        places[i, k] = wp.int64(r * 2 * rows + c)
        down = wp.where(k < 2, 1.0 - (row - top), row - top)
        across = wp.where(k % 2 == 0, 1.0 - (at[0] - left), at[0] - left)
        shares[i, k] = down * across


@wp.kernel
def look_up(
    directions: wp.array[wp.vec3], mask: wp.array2d[wp.uint8], out: wp.array[wp.uint8],
    first: int,
):  # fmt: skip
    """What a mask `[R, 2 R]` says of each direction: as `recon.skies.cells` does."""
    i = first + wp.tid()
    rows = mask.shape[0]
    at = place(directions[i], rows)
    out[i] = mask[wp.clamp(int(at[1]), 0, rows - 1), int(at[0]) % (2 * rows)]
