"""Spherical harmonics to degree 3 and their gradients; constants and order as in `scenes.harmonics`."""

import warp as wp

from scenes.harmonics import C0 as _C0
from scenes.harmonics import C1 as _C1
from scenes.harmonics import C2 as _C2
from scenes.harmonics import C3 as _C3

C0 = wp.constant(_C0)
C1 = wp.constant(_C1)
C20, C21, C22, C23, C24 = (wp.constant(c) for c in _C2)
C30, C31, C32, C33, C34, C35, C36 = (wp.constant(c) for c in _C3)


@wp.func
def harmonics(sh: wp.array2d[wp.vec3], i: int, count: int, d: wp.vec3):
    """The colour of splat i along unit direction d, before the clamp at 0."""
    x = d[0]
    y = d[1]
    z = d[2]
    c = wp.vec3(0.5) + C0 * sh[i, 0]
    if count > 1:
        c += C1 * (z * sh[i, 2] - y * sh[i, 1] - x * sh[i, 3])
    if count > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        c += (C20 * x * y) * sh[i, 4] + (C21 * y * z) * sh[i, 5] + (C22 * (2.0 * zz - xx - yy)) * sh[i, 6]
        c += (C23 * x * z) * sh[i, 7] + (C24 * (xx - yy)) * sh[i, 8]
        if count > 9:
            c += (C30 * y * (3.0 * xx - yy)) * sh[i, 9] + (C31 * x * y * z) * sh[i, 10] + (C32 * y * (4.0 * zz - xx - yy)) * sh[i, 11]
            c += (C33 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)) * sh[i, 12] + (C34 * x * (4.0 * zz - xx - yy)) * sh[i, 13]
            c += (C35 * z * (xx - yy)) * sh[i, 14] + (C36 * x * (xx - 3.0 * yy)) * sh[i, 15]
    return c


@wp.func
def harmonics_backward(sh: wp.array2d[wp.vec3], i: int, count: int, d: wp.vec3, g: wp.vec3, g_sh: wp.array2d[wp.vec3]):
    """Write d loss / d sh of splat i for colour gradient g; return d loss / d direction (not yet kept on the sphere)."""
    x = d[0]
    y = d[1]
    z = d[2]
    g_d = wp.vec3(0.0)
    g_sh[i, 0] = C0 * g
    if count > 1:
        g_sh[i, 1] = (-C1 * y) * g
        g_sh[i, 2] = (C1 * z) * g
        g_sh[i, 3] = (-C1 * x) * g
        g_d += C1 * wp.vec3(-wp.dot(sh[i, 3], g), -wp.dot(sh[i, 1], g), wp.dot(sh[i, 2], g))
    if count > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        g_sh[i, 4] = (C20 * x * y) * g
        g_sh[i, 5] = (C21 * y * z) * g
        g_sh[i, 6] = (C22 * (2.0 * zz - xx - yy)) * g
        g_sh[i, 7] = (C23 * x * z) * g
        g_sh[i, 8] = (C24 * (xx - yy)) * g
        g_d += (C20 * wp.dot(sh[i, 4], g)) * wp.vec3(y, x, 0.0)
        g_d += (C21 * wp.dot(sh[i, 5], g)) * wp.vec3(0.0, z, y)
        g_d += (C22 * wp.dot(sh[i, 6], g)) * wp.vec3(-2.0 * x, -2.0 * y, 4.0 * z)
        g_d += (C23 * wp.dot(sh[i, 7], g)) * wp.vec3(z, 0.0, x)
        g_d += (C24 * wp.dot(sh[i, 8], g)) * wp.vec3(2.0 * x, -2.0 * y, 0.0)
        if count > 9:
            g_sh[i, 9] = (C30 * y * (3.0 * xx - yy)) * g
            g_sh[i, 10] = (C31 * x * y * z) * g
            g_sh[i, 11] = (C32 * y * (4.0 * zz - xx - yy)) * g
            g_sh[i, 12] = (C33 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)) * g
            g_sh[i, 13] = (C34 * x * (4.0 * zz - xx - yy)) * g
            g_sh[i, 14] = (C35 * z * (xx - yy)) * g
            g_sh[i, 15] = (C36 * x * (xx - 3.0 * yy)) * g
            g_d += (C30 * wp.dot(sh[i, 9], g)) * wp.vec3(6.0 * x * y, 3.0 * xx - 3.0 * yy, 0.0)
            g_d += (C31 * wp.dot(sh[i, 10], g)) * wp.vec3(y * z, x * z, x * y)
            g_d += (C32 * wp.dot(sh[i, 11], g)) * wp.vec3(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z)
            g_d += (C33 * wp.dot(sh[i, 12], g)) * wp.vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy)
            g_d += (C34 * wp.dot(sh[i, 13], g)) * wp.vec3(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z)
            g_d += (C35 * wp.dot(sh[i, 14], g)) * wp.vec3(2.0 * x * z, -2.0 * y * z, xx - yy)
            g_d += (C36 * wp.dot(sh[i, 15], g)) * wp.vec3(3.0 * xx - 3.0 * yy, -6.0 * x * y, 0.0)
    return g_d
