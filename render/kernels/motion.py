"""A pose that changes while the image is read out: cam_from_local as a polynomial of the readout's share s, of degree 5, in float64.

It goes through the true pose (slerp and lerp, `scenes.poses.interpolate`) at s = 0, 1/5, .. 1; of a turn by an angle a, of camera and
instance together, it is off by about a^6 / 670,000: 2e-6 for 60 degrees, 1e-4 for 120, nothing for 100 degrees a second over 33 ms. A
cubic would do for pictures, with a^4 / 1900, and not for gradients, whose error is the derivative of that: 4e-6 where camera and car turn
by 7 degrees together. A global shutter has the constant term alone.
"""

import warp as wp

from render.kernels.types import matrix_at, vector_at

POWERS = 6
"""Of the readout's share, with which a pose that moves is written."""

TWO, THREE, FOUR, FIVE = (wp.constant(wp.float64(n)) for n in range(2, 6))


@wp.struct
class Motion:
    """cam_from_local at s is the sum of r_k s^k, t_k s^k; s runs from 0 to 1 along `axis` (0: columns, 1: rows) over `extent` pixels."""

    r0: wp.mat33d
    r1: wp.mat33d
    r2: wp.mat33d
    r3: wp.mat33d
    r4: wp.mat33d
    r5: wp.mat33d
    t0: wp.vec3d
    t1: wp.vec3d
    t2: wp.vec3d
    t3: wp.vec3d
    t4: wp.vec3d
    t5: wp.vec3d
    axis: int
    extent: wp.float64
    instance: float
    copy: int  # 1 draws what lies on one side of a lens's seam on the other


@wp.func
def rotation_at(m: Motion, s: wp.float64):
    return m.r0 + s * (m.r1 + s * (m.r2 + s * (m.r3 + s * (m.r4 + s * m.r5))))


@wp.func
def translation_at(m: Motion, s: wp.float64):
    return m.t0 + s * (m.t1 + s * (m.t2 + s * (m.t3 + s * (m.t4 + s * m.t5))))


@wp.func
def rotation_rate(m: Motion, s: wp.float64):
    return m.r1 + s * (TWO * m.r2 + s * (THREE * m.r3 + s * (FOUR * m.r4 + s * FIVE * m.r5)))


@wp.func
def translation_rate(m: Motion, s: wp.float64):
    return m.t1 + s * (TWO * m.t2 + s * (THREE * m.t3 + s * (FOUR * m.t4 + s * FIVE * m.t5)))


@wp.func
def motion_of(rows: wp.array2d[wp.float64], d: int):
    """Row d: for each power its rotation (row major) and translation, then axis, extent, instance, copy."""
    m = Motion()
    m.r0 = matrix_at(rows, d, 0)
    m.t0 = vector_at(rows, d, 9)
    m.r1 = matrix_at(rows, d, 12)
    m.t1 = vector_at(rows, d, 21)
    m.r2 = matrix_at(rows, d, 24)
    m.t2 = vector_at(rows, d, 33)
    m.r3 = matrix_at(rows, d, 36)
    m.t3 = vector_at(rows, d, 45)
    m.r4 = matrix_at(rows, d, 48)
    m.t4 = vector_at(rows, d, 57)
    m.r5 = matrix_at(rows, d, 60)
    m.t5 = vector_at(rows, d, 69)
    m.axis = int(rows[d, 72])
    m.extent = rows[d, 73]
    m.instance = float(rows[d, 74])
    m.copy = int(rows[d, 75])
    return m
