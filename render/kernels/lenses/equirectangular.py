"""The whole sphere (`scenes.lenses.Equirectangular`): fx fy cx cy."""

import warp as wp

from render.kernels.lenses.optics import Optics, mat23d, params


@wp.func
def around(v: wp.vec3d):
    """Longitude and latitude."""
    return wp.vec2d(wp.atan2(v[0], v[2]), wp.atan2(v[1], wp.sqrt(v[0] * v[0] + v[2] * v[2])))


@wp.func
def pixel(o: Optics, v: wp.vec3d):
    a = around(v)
    return wp.vec2d(o.p[0] * a[0] + o.p[2], o.p[1] * a[1] + o.p[3])


@wp.func
def jacobian(o: Optics, v: wp.vec3d):
    flat = v[0] * v[0] + v[2] * v[2]
    side = wp.sqrt(flat)
    away = flat + v[1] * v[1]
    x = o.p[0] / flat
    y = o.p[1] / away
    return mat23d(x * v[2], wp.float64(0.0), -x * v[0], -y * v[0] * v[1] / side, y * side, -y * v[2] * v[1] / side)


@wp.func
def params_gradient(o: Optics, v: wp.vec3d, g: wp.vec2d):
    a = around(v)
    out = params()
    out[0] = g[0] * a[0]
    out[1] = g[1] * a[1]
    out[2] = g[0]
    out[3] = g[1]
    return out
