"""What of an equirectangular picture a direction looks at."""

import warp as wp

from render.kernels.equirect import corners, place
from render.kernels.types import OPTIONS

wp.set_module_options(OPTIONS)


@wp.kernel
def find_corners(
    directions: wp.array[wp.vec3], rows: int, places: wp.array2d[wp.int64], shares: wp.array2d[float],
    first: int,
):  # fmt: skip
    """The four pixels, of those of a picture `[rows, 2 rows]` one after the other, between whose middles each direction looks, and how
    much of each it sees: as `scenes.sky.sample_equirect` does."""
    i = first + wp.tid()
    k, f = corners(directions[i], rows, 2 * rows)
    for n in range(4):
        places[i, n] = wp.int64(k[n // 2] * 2 * rows + k[2 + n % 2])
        shares[i, n] = wp.where(n < 2, 1.0 - f[1], f[1]) * wp.where(n % 2 == 0, 1.0 - f[0], f[0])


@wp.kernel
def look_up(
    directions: wp.array[wp.vec3], mask: wp.array2d[wp.uint8], out: wp.array[wp.uint8],
    first: int,
):  # fmt: skip
    """What a mask `[R, 2 R]` says of each direction: as `recon.views.skies.cells` does."""
    i = first + wp.tid()
    rows = mask.shape[0]
    at = place(directions[i], rows, 2 * rows)
    out[i] = mask[wp.clamp(int(at[1]), 0, rows - 1), int(at[0]) % (2 * rows)]
