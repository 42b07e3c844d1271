"""Where a direction looks in an equirectangular picture `[H, 2 H]`, as `scenes.sky.sample_equirect` has it."""

import warp as wp

from render.kernels.types import OPTIONS

wp.set_module_options(OPTIONS)

PI = wp.constant(3.14159265358979)


@wp.func
def place(d: wp.vec3, height: int, width: int):
    """Column and row, pixels' edges whole."""
    column = (0.5 - wp.atan2(d[1], d[0]) / (2.0 * PI)) * float(width)
    row = (0.5 - wp.atan2(d[2], wp.sqrt(d[0] * d[0] + d[1] * d[1])) / PI) * float(height)
    return wp.vec2(column, row)


@wp.func
def corners(d: wp.vec3, height: int, width: int):
    """The two rows and the two columns between whose pixels' middles a direction looks, and how far towards the second column and row:
    columns wrap around, rows end at the poles."""
    at = place(d, height, width)
    column = at[0] - 0.5
    row = wp.clamp(at[1] - 0.5, 0.0, float(height - 1))
    left = wp.floor(column)
    top = wp.min(wp.floor(row), float(wp.max(height - 2, 0)))
    c0 = (int(left) + width) % width
    r0 = int(top)
    return wp.vec4i(r0, wp.min(r0 + 1, height - 1), c0, (c0 + 1) % width), wp.vec2(column - left, row - top)
