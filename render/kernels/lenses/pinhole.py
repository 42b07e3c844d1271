"""The pinhole (`scenes.lenses.Pinhole`), for shutters that move; a global one has `render.kernels.project`."""

import warp as wp

from render.kernels.lenses.optics import Optics, mat23d, params


@wp.func
def pixel(o: Optics, v: wp.vec3d):
    return wp.vec2d(o.p[0] * v[0] / v[2] + o.p[2], o.p[1] * v[1] / v[2] + o.p[3])


@wp.func
def jacobian(o: Optics, v: wp.vec3d):
    x = o.p[0] / v[2]
    y = o.p[1] / v[2]
    zero = wp.float64(0.0)
    return mat23d(x, zero, -x * v[0] / v[2], zero, y, -y * v[1] / v[2])


@wp.func
def params_gradient(o: Optics, v: wp.vec3d, g: wp.vec2d):
    out = params()
    out[0] = g[0] * v[0] / v[2]
    out[1] = g[1] * v[1] / v[2]
    out[2] = g[0]
    out[3] = g[1]
    return out
