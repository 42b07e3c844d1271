"""A pose that changes while the image is read out: cam_from_local as a cubic of the readout's share s, in float64.

The cubic goes through the true pose (slerp and lerp, `scenes.poses.interpolate`) at s = 0, 1/3, 2/3 and 1; of a turn by an angle a
it is off by at most a^4 / 1900, 5e-9 for 100 degrees a second over 33 ms. A global shutter has the constant term alone.
"""

import warp as wp

from render.kernels.types import matrix_at, vector_at


@wp.struct
class Motion:
    """cam_from_local at s is the sum of r_k s^k, t_k s^k; s runs from 0 to 1 along `axis` (0: columns, 1: rows) over `extent` pixels."""

    r0: wp.mat33d
    r1: wp.mat33d
    r2: wp.mat33d
    r3: wp.mat33d
    t0: wp.vec3d
    t1: wp.vec3d
    t2: wp.vec3d
    t3: wp.vec3d
    axis: int
    extent: wp.float64
    instance: float
    copy: int  # 1 draws what lies on one side of a lens's seam on the other


@wp.func
def rotation_at(m: Motion, s: wp.float64):
    return m.r0 + s * (m.r1 + s * (m.r2 + s * m.r3))


@wp.func
def translation_at(m: Motion, s: wp.float64):
    return m.t0 + s * (m.t1 + s * (m.t2 + s * m.t3))


@wp.func
def rotation_rate(m: Motion, s: wp.float64):
    return m.r1 + s * (wp.float64(2.0) * m.r2 + s * wp.float64(3.0) * m.r3)


@wp.func
def translation_rate(m: Motion, s: wp.float64):
    return m.t1 + s * (wp.float64(2.0) * m.t2 + s * wp.float64(3.0) * m.t3)


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
    m.axis = int(rows[d, 48])
    m.extent = rows[d, 49]
    m.instance = float(rows[d, 50])
    m.copy = int(rows[d, 51])
    return m
