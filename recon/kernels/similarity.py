"""Structural similarity of two pictures, from their windows' means, and its slopes."""

from functools import cache

import warp as wp

from render.kernels.types import OPTIONS

wp.set_module_options(OPTIONS)


@cache
def similar_kernel(real: type) -> wp.Kernel:
    """For pictures of wp.float32 or wp.float64."""

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def similar(
        maps: wp.array3d[real], c1: real, c2: real, value: wp.array3d[real], slopes: wp.array3d[real],
        first: int,
    ):  # fmt: skip
        """maps `[h, w, 5C]`: the windows' means of a, b, a a, b b and a b. value `[h, w, C]`, and slopes `[h, w, 3C]`: what it changes by
        with those of a, a a and a b (Wang et al. 2004, equation 13)."""
        y = (first + wp.tid()) / maps.shape[1]
        x = (first + wp.tid()) % maps.shape[1]
        channels = value.shape[2]
        two = real(2.0)
        for c in range(channels):
            a = maps[y, x, c]
            b = maps[y, x, channels + c]
            product = a * b
            squares = a * a + b * b
            top_mean = two * product + c1
            top = two * (maps[y, x, 4 * channels + c] - product) + c2
            bottom_mean = squares + c1
            bottom = maps[y, x, 2 * channels + c] + maps[y, x, 3 * channels + c] - squares + c2
            below = real(1.0) / (bottom_mean * bottom)
            s = top_mean * top * below
            value[y, x, c] = s
            slopes[y, x, c] = two * b * (top - top_mean) * below - two * a * s * (real(1.0) / bottom_mean - real(1.0) / bottom)
            slopes[y, x, channels + c] = -s / bottom
            slopes[y, x, 2 * channels + c] = two * top_mean * below

    return similar
