"""The fields of a splat as its kernels use them: rotation, scale, opacity."""

import warp as wp

from render.kernels.types import LEAST, ONE, TWO


@wp.func
def length_of(q: wp.vec4):
    return wp.max(wp.length(wp.vec4d(q)), LEAST)


@wp.func
def unit(q: wp.vec4):
    return wp.vec4d(q) / length_of(q)


@wp.func
def rotation(q: wp.vec4):
    """Rotation of a quaternion wxyz of any positive length; in float64, since a needle's end moves by its length times what is off here."""
    n = unit(q)
    w = n[0]
    x = n[1]
    y = n[2]
    z = n[3]
    return wp.mat33d(
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y),
    )  # fmt: skip


@wp.func
def rotation_backward(q: wp.vec4, g: wp.mat33d):
    """d loss / d quaternion, normalisation included."""
    n = unit(q)
    w = n[0]
    x = n[1]
    y = n[2]
    z = n[3]
    g_n = TWO * wp.vec4d(
        x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]),
        w * (g[2, 1] - g[1, 2]) + y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) - TWO * x * (g[1, 1] + g[2, 2]),
        w * (g[0, 2] - g[2, 0]) + x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) - TWO * y * (g[0, 0] + g[2, 2]),
        w * (g[1, 0] - g[0, 1]) + x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) - TWO * z * (g[0, 0] + g[1, 1]),
    )
    return wp.vec4((g_n - n * wp.dot(n, g_n)) / length_of(q))


@wp.func
def exp_scale(log_scale: wp.vec3):
    return wp.vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))


@wp.func
def sigmoid(x: float):
    return 1.0 / (1.0 + wp.exp(-x))
