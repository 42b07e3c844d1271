"""Flattening of what lies on the ground, in place."""

import warp as wp

from render.kernels.types import OPTIONS

wp.set_module_options(OPTIONS)

ROUNDNESS = wp.constant(0.01)  # keeps a turn finite where two axes are as long as one another, and any direction is an axis


@wp.struct
class Grid:
    """Where heights `[Y, X]` are: at `(x, y) + cell * (column, row)`."""

    x: float
    y: float
    cell: float


@wp.kernel
def press(
    which: wp.array[wp.int64], count: int, grid: Grid, heights: wp.array2d[float], part: float, near: float,
    means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
    first: int,
):  # fmt: skip
    """Of splats `which`, those of the first `count` nearer than `near` to the ground lose `part` of their extent along its normal.

    With D = 1 - part n n^T a covariance becomes D C D, to first order in `part`: in the splat's own axes its diagonal is what its scales
    lose, and the rest is a turn of its axes.
    """
    i = int(which[first + wp.tid()])
    if i >= count:
        return
    p = means[i]
    column = wp.clamp((p[0] - grid.x) / grid.cell, 0.0, float(heights.shape[1] - 1))
    row = wp.clamp((p[1] - grid.y) / grid.cell, 0.0, float(heights.shape[0] - 1))
    c = wp.min(int(column), heights.shape[1] - 2)
    r = wp.min(int(row), heights.shape[0] - 2)
    u = column - float(c)
    v = row - float(r)
    near_left = heights[r, c]
    near_right = heights[r, c + 1]
    far_left = heights[r + 1, c]
    far_right = heights[r + 1, c + 1]
    height = (near_left * (1.0 - u) + near_right * u) * (1.0 - v) + (far_left * (1.0 - u) + far_right * u) * v
    if wp.abs(p[2] - height) > near:
        return
    along_x = ((near_right - near_left) * (1.0 - v) + (far_right - far_left) * v) / grid.cell
    along_y = ((far_left - near_left) * (1.0 - u) + (far_right - near_right) * u) / grid.cell
    up = wp.normalize(wp.vec3(-along_x, -along_y, 1.0))

    q = quats[i]
    w = q[0]
    xyz = wp.vec3(q[1], q[2], q[3])
    # the normal in the splat's axes, by the inverse of its rotation
    double = 2.0 * wp.cross(up, xyz) / wp.dot(q, q)
    n = up + w * double + wp.cross(double, xyz)
    scales = log_scales[i]
    turn = wp.vec3()
    for k in range(3):
        a = (k + 1) % 3
        b = (k + 2) % 3
        longer = wp.tanh(scales[a] - scales[b])  # (a^2 - b^2) / (a^2 + b^2) of the two axes
        turn[k] = -part * n[a] * n[b] * longer / (longer * longer + ROUNDNESS)
    half = 0.5 * turn
    turned = w * half + xyz + wp.cross(xyz, half)
    quats[i] = wp.vec4(w - wp.dot(xyz, half), turned[0], turned[1], turned[2])
    log_scales[i] = scales - part * wp.cw_mul(n, n)
