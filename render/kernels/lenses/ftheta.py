"""The f-theta lens (`scenes.lenses.FTheta`): cx cy a1 a2 a3 a4 a5 c d e."""

import warp as wp

from render.kernels.lenses.angles import angle, stretch, stretch_jacobian
from render.kernels.lenses.optics import Optics, mat23d, params


@wp.func
def radius(o: Optics, a: wp.float64):
    return a * (o.p[2] + a * (o.p[3] + a * (o.p[4] + a * (o.p[5] + a * o.p[6]))))


@wp.func
def slope(o: Optics, a: wp.float64):
    outer = wp.float64(4.0) * o.p[5] + a * wp.float64(5.0) * o.p[6]
    return o.p[2] + a * (wp.float64(2.0) * o.p[3] + a * (wp.float64(3.0) * o.p[4] + a * outer))


@wp.func
def pixel(o: Optics, v: wp.vec3d):
    a = angle(v)
    s = stretch(v, radius(o, a), slope(o, a))
    x = s * v[0]
    y = s * v[1]
    return wp.vec2d(o.p[7] * x + o.p[8] * y + o.p[0], o.p[9] * x + y + o.p[1])


@wp.func
def jacobian(o: Optics, v: wp.vec3d):
    a = angle(v)
    j = stretch_jacobian(v, radius(o, a), slope(o, a))
    c = o.p[7]
    d = o.p[8]
    e = o.p[9]
    return mat23d(
        c * j[0, 0] + d * j[1, 0], c * j[0, 1] + d * j[1, 1], c * j[0, 2] + d * j[1, 2],
        e * j[0, 0] + j[1, 0], e * j[0, 1] + j[1, 1], e * j[0, 2] + j[1, 2],
    )  # fmt: skip


@wp.func
def params_gradient(o: Optics, v: wp.vec3d, g: wp.vec2d):
    a = angle(v)
    s = stretch(v, radius(o, a), slope(o, a))
    out = params()
    out[0] = g[0]
    out[1] = g[1]
    k = (g[0] * (o.p[7] * v[0] + o.p[8] * v[1]) + g[1] * (o.p[9] * v[0] + v[1])) * stretch(v, a, wp.float64(1.0))
    out[2] = k
    out[3] = k * a
    out[4] = k * a * a
    out[5] = k * a * a * a
    out[6] = k * a * a * a * a
    out[7] = g[0] * s * v[0]
    out[8] = g[0] * s * v[1]
    out[9] = g[1] * s * v[0]
    return out
