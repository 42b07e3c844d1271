"""Lenses by angle: where radius(angle) places a direction, for the fisheye and the f-theta lens."""

import warp as wp

from render.kernels.lenses.optics import mat23d

ON_AXIS = wp.constant(wp.float64(1.0e-24))


@wp.func
def angle(v: wp.vec3d):
    return wp.atan2(wp.sqrt(v[0] * v[0] + v[1] * v[1]), v[2])


@wp.func
def stretch(v: wp.vec3d, radius: wp.float64, slope: wp.float64):
    """What x and y are multiplied by: radius / |xy|, on the axis its limit slope / z."""
    square = v[0] * v[0] + v[1] * v[1]
    if square <= ON_AXIS * v[2] * v[2]:
        return slope / v[2]
    return radius / wp.sqrt(square)


@wp.func
def stretch_jacobian(v: wp.vec3d, radius: wp.float64, slope: wp.float64):
    """d (stretch x, stretch y) / d v; slope is d radius / d angle."""
    square = v[0] * v[0] + v[1] * v[1]
    away = square + v[2] * v[2]
    s = stretch(v, radius, slope)
    along = wp.float64(0.0)
    if square > ON_AXIS * v[2] * v[2]:
        along = (slope * v[2] / away - s) / square
    down = -slope / away
    return mat23d(
        s + along * v[0] * v[0], along * v[0] * v[1], down * v[0],
        along * v[0] * v[1], s + along * v[1] * v[1], down * v[1],
    )  # fmt: skip
