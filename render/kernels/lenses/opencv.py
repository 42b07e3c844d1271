"""OpenCV's distortion (`scenes.lenses.OpenCV`): fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4."""

import warp as wp

from render.kernels.lenses.optics import Optics, mat23d, params


@wp.func
def above(o: Optics, q: wp.float64):
    return wp.float64(1.0) + q * (o.p[4] + q * (o.p[5] + q * o.p[8]))


@wp.func
def below(o: Optics, q: wp.float64):
    return wp.float64(1.0) + q * (o.p[9] + q * (o.p[10] + q * o.p[11]))


@wp.func
def bent(o: Optics, x: wp.float64, y: wp.float64):
    """x, y on the plane z = 1, distorted."""
    two = wp.float64(2.0)
    q = x * x + y * y
    factor = above(o, q) / below(o, q)
    return wp.vec2d(
        x * factor + two * o.p[6] * x * y + o.p[7] * (q + two * x * x) + q * (o.p[12] + q * o.p[13]),
        y * factor + o.p[6] * (q + two * y * y) + two * o.p[7] * x * y + q * (o.p[14] + q * o.p[15]),
    )


@wp.func
def pixel(o: Optics, v: wp.vec3d):
    d = bent(o, v[0] / v[2], v[1] / v[2])
    return wp.vec2d(o.p[0] * d[0] + o.p[2], o.p[1] * d[1] + o.p[3])


@wp.func
def jacobian(o: Optics, v: wp.vec3d):
    two = wp.float64(2.0)
    six = wp.float64(6.0)
    x = v[0] / v[2]
    y = v[1] / v[2]
    q = x * x + y * y
    factor = above(o, q) / below(o, q)
    slope_above = o.p[4] + q * (two * o.p[5] + q * wp.float64(3.0) * o.p[8])
    slope_below = o.p[9] + q * (two * o.p[10] + q * wp.float64(3.0) * o.p[11])
    slope = (slope_above - factor * slope_below) / below(o, q)
    prism_x = o.p[12] + two * o.p[13] * q
    prism_y = o.p[14] + two * o.p[15] * q
    cross = two * (x * y * slope + o.p[6] * x + o.p[7] * y)
    xx = (factor + two * x * x * slope + two * o.p[6] * y + six * o.p[7] * x + two * x * prism_x) * o.p[0] / v[2]
    xy = (cross + two * y * prism_x) * o.p[0] / v[2]
    yx = (cross + two * x * prism_y) * o.p[1] / v[2]
    yy = (factor + two * y * y * slope + six * o.p[6] * y + two * o.p[7] * x + two * y * prism_y) * o.p[1] / v[2]
    return mat23d(xx, xy, -(xx * x + xy * y), yx, yy, -(yx * x + yy * y))


@wp.func
def params_gradient(o: Optics, v: wp.vec3d, g: wp.vec2d):
    two = wp.float64(2.0)
    x = v[0] / v[2]
    y = v[1] / v[2]
    q = x * x + y * y
    d = bent(o, x, y)
    gx = g[0] * o.p[0]
    gy = g[1] * o.p[1]
    radial = (gx * x + gy * y) * q / below(o, q)
    rational = -radial * above(o, q) / below(o, q)
    out = params()
    out[0] = g[0] * d[0]
    out[1] = g[1] * d[1]
    out[2] = g[0]
    out[3] = g[1]
    out[4] = radial
    out[5] = radial * q
    out[6] = gx * two * x * y + gy * (q + two * y * y)
    out[7] = gx * (q + two * x * x) + gy * two * x * y
    out[8] = radial * q * q
    out[9] = rational
    out[10] = rational * q
    out[11] = rational * q * q
    out[12] = gx * q
    out[13] = gx * q * q
    out[14] = gy * q
    out[15] = gy * q * q
    return out
