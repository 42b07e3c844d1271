"""Points of a picture, carried to where they stand for another camera."""

import warp as wp

from render.kernels.types import OPTIONS

wp.set_module_options(OPTIONS)


@wp.kernel
def carry(
    points: wp.array2d[wp.vec3], who: wp.array2d[int], ways: wp.array3d[wp.mat44], by_columns: int, shares: wp.array2d[float],
    carried: wp.array2d[wp.vec3],
    first: int,
):  # fmt: skip
    """ways[who, k, line]: coefficient of the k-th power of the share; the line is the pixel's row or column where each has its own."""
    row = first + wp.tid()
    powers = ways.shape[1]
    for column in range(points.shape[1]):
        line = int(0)
        if ways.shape[2] > 1:
            line = wp.where(by_columns != 0, column, row)
        i = who[row, column]
        p = points[row, column]
        v = wp.transform_point(ways[i, powers - 1, line], p)
        for k in range(1, powers):
            v = wp.transform_point(ways[i, powers - 1 - k, line], p) + shares[row, column] * v
        carried[row, column] = v
