"""Flattening of what lies on the ground, in place."""

import warp as wp

from render.kernels.types import OPTIONS

wp.set_module_options(OPTIONS)

ROUNDNESS = wp.constant(0.01)  # keeps a turn finite where two axes are as long as one another, and any direction is an axis


@wp.struct
class Grid:
    """Where heights and slopes `[Y, X]` are: at `(x, y) + cell * (column, row)`."""

    x: float
    y: float
    cell: float


@wp.kernel
def press(
    which: wp.array[wp.int64], count: int, last: wp.array[float], now: float,
    grid: Grid, heights: wp.array2d[float], slopes: wp.array2d[wp.vec2], near: wp.array2d[wp.vec2],
    part: float, level: float, eye: wp.vec3, lowest: float, pull: float,
    moments: wp.array3d[float], colour: int, part_unseen: float,
    means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
    first: int,
):  # fmt: skip
    """Of splats `which`, those of the first `count` that moved `now`, are less than `near` says, metres below and above, from the ground,
    and no thicker than it says above, lose `part` of their extent along its normal and `level` of their axes' tilt against it, and `pull`
    of how far they are off it, along the ray to the eye, if that is `lowest` above them. Those that no picture has pulled at, as moments
    from `colour` on tell, lose another part of both, however thick they are.

    With D = 1 - part n n^T a covariance becomes D C D, to first order in `part`: in the splat's own axes its diagonal is what its scales
    lose, and the rest is a turn of its axes, which is made as if the part were `level`.
    """
    i = int(which[first + wp.tid()])
    if i >= count or last[i] != now:
        return
    p = means[i]
    column = (p[0] - grid.x) / grid.cell
    row = (p[1] - grid.y) / grid.cell
    inside = column >= 0.0 and row >= 0.0 and column < float(heights.shape[1] - 1) and row < float(heights.shape[0] - 1)
    if not inside:
        return
    c = int(column)
    r = int(row)
    u = column - float(c)
    v = row - float(r)
    height = (heights[r, c] * (1.0 - u) + heights[r, c + 1] * u) * (1.0 - v) + (
        heights[r + 1, c] * (1.0 - u) + heights[r + 1, c + 1] * u
    ) * v
    rise = p[2] - height
    nearest_r = int(row + 0.5)
    nearest_c = int(column + 0.5)
    limits = near[nearest_r, nearest_c]
    if rise < -limits[0] or rise > limits[1]:
        return
    unseen = moments[i, 1, colour] + moments[i, 1, colour + 1] + moments[i, 1, colour + 2] == 0.0
    slope = slopes[nearest_r, nearest_c]
    up = wp.normalize(wp.vec3(-slope[0], -slope[1], 1.0))

    q = quats[i]
    w = q[0]
    xyz = wp.vec3(q[1], q[2], q[3])
    # the normal in the splat's axes, by the inverse of its rotation
    double = 2.0 * wp.cross(up, xyz) / wp.dot(q, q)
    n = up + w * double + wp.cross(double, xyz)
    scales = log_scales[i]
    thick = wp.length(wp.vec3(n[0] * wp.exp(scales[0]), n[1] * wp.exp(scales[1]), n[2] * wp.exp(scales[2])))
    if unseen:
        part = part_unseen
        level = part_unseen
    elif thick > limits[1]:
        return
    drop = eye[2] - p[2]
    if drop > lowest:
        means[i] = p + (pull * rise / drop) * (p - eye)
    turn = wp.vec3()
    for k in range(3):
        a = (k + 1) % 3
        b = (k + 2) % 3
        longer = wp.tanh(scales[a] - scales[b])  # (a^2 - b^2) / (a^2 + b^2) of the two axes
        turn[k] = -level * n[a] * n[b] * longer / (longer * longer + ROUNDNESS)
    half = 0.5 * turn
    turned = w * half + xyz + wp.cross(xyz, half)
    quats[i] = wp.vec4(w - wp.dot(xyz, half), turned[0], turned[1], turned[2])
    log_scales[i] = scales - part * wp.cw_mul(n, n)
