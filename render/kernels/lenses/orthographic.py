"""Parallel rays (`scenes.lenses.Orthographic`)."""

import warp as wp

from render.kernels.lenses.optics import Optics, mat23d, params


@wp.func
def pixel(o: Optics, v: wp.vec3d):
    return wp.vec2d(o.p[0] * v[0] + o.p[2], o.p[1] * v[1] + o.p[3])


@wp.func
def jacobian(o: Optics, v: wp.vec3d):
    zero = wp.float64(0.0)
    return mat23d(o.p[0], zero, zero, zero, o.p[1], zero)


@wp.func
def params_gradient(o: Optics, v: wp.vec3d, g: wp.vec2d):
    out = params()
    out[0] = g[0] * v[0]
    out[1] = g[1] * v[1]
    out[2] = g[0]
    out[3] = g[1]
    return out
