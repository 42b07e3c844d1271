"""The fields of a splat as its kernels use them: rotation, scale, opacity."""

import warp as wp

from render.kernels.types import TINY


@wp.func
def rotation(q: wp.vec4):
    """Rotation of a quaternion wxyz of any positive length."""
    n = q / wp.max(wp.length(q), TINY)
    w = n[0]
    x = n[1]
    y = n[2]
    z = n[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def rotation_backward(q: wp.vec4, g: wp.mat33):
    """d loss / d quaternion, normalisation included."""
    length = wp.max(wp.length(q), TINY)
    n = q / length
    w = n[0]
    x = n[1]
    y = n[2]
    z = n[3]
    g_n = 2.0 * wp.vec4(
        x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]),
        w * (g[2, 1] - g[1, 2]) + y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) - 2.0 * x * (g[1, 1] + g[2, 2]),
        w * (g[0, 2] - g[2, 0]) + x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) - 2.0 * y * (g[0, 0] + g[2, 2]),
        w * (g[1, 0] - g[0, 1]) + x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) - 2.0 * z * (g[0, 0] + g[1, 1]),
    )
    return (g_n - n * wp.dot(n, g_n)) / length


@wp.func
def exp_scale(log_scale: wp.vec3):
    return wp.vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))


@wp.func
def sigmoid(x: float):
    return 1.0 / (1.0 + wp.exp(-x))
