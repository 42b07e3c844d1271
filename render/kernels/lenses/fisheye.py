"""Kannala and Brandt's fisheye (`scenes.lenses.Fisheye`): fx fy cx cy k1 k2 k3 k4."""

import warp as wp

from render.kernels.lenses.angles import angle, stretch, stretch_jacobian
from render.kernels.lenses.optics import Optics, mat23d, params


@wp.func
def radius(o: Optics, a: wp.float64):
    q = a * a
    return a * (wp.float64(1.0) + q * (o.p[4] + q * (o.p[5] + q * (o.p[6] + q * o.p[7]))))


@wp.func
def slope(o: Optics, a: wp.float64):
    q = a * a
    outer = wp.float64(7.0) * o.p[6] + q * wp.float64(9.0) * o.p[7]
    return wp.float64(1.0) + q * (wp.float64(3.0) * o.p[4] + q * (wp.float64(5.0) * o.p[5] + q * outer))


@wp.func
def pixel(o: Optics, v: wp.vec3d):
    a = angle(v)
    s = stretch(v, radius(o, a), slope(o, a))
    return wp.vec2d(o.p[0] * s * v[0] + o.p[2], o.p[1] * s * v[1] + o.p[3])


@wp.func
def jacobian(o: Optics, v: wp.vec3d):
    a = angle(v)
    j = stretch_jacobian(v, radius(o, a), slope(o, a))
    fx = o.p[0]
    fy = o.p[1]
    return mat23d(fx * j[0, 0], fx * j[0, 1], fx * j[0, 2], fy * j[1, 0], fy * j[1, 1], fy * j[1, 2])


@wp.func
def params_gradient(o: Optics, v: wp.vec3d, g: wp.vec2d):
    a = angle(v)
    s = stretch(v, radius(o, a), slope(o, a))
    # d radius / d k_n = a^(2n+1), and both are stretched alike
    q = a * a
    k = (g[0] * o.p[0] * v[0] + g[1] * o.p[1] * v[1]) * stretch(v, a, wp.float64(1.0)) * q
    out = params()
    out[0] = g[0] * s * v[0]
    out[1] = g[1] * s * v[1]
    out[2] = g[0]
    out[3] = g[1]
    out[4] = k
    out[5] = k * q
    out[6] = k * q * q
    out[7] = k * q * q * q
    return out
