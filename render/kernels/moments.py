"""The 2D Gaussian of a splat behind a pinhole, EWA or unscented, in closed form, and its derivative.

Axis k of the splat, as an offset o from its centre t in the camera, moves the pixel along e = f (o_xy - n o_z), n = t_xy / t_z. EWA
moves it by e / z. The unscented transform (alpha = 1, beta = 2, kappa = 0, so sigma points at +-sqrt(3)) moves it by +-r e with
r = sqrt(3) / (z +- sqrt(3) o_z): exact for a pinhole and free of cancellation, since nothing is measured from the image origin. Then

    covariance = sum_k w_k e_k e_k' + mu mu',   mu = sum_k b_k e_k,   w = (r+^2 + r-^2) / 6,  b = (r+ - r-) / 6

and its determinant is a sum of squares (Cauchy-Binet), so that needles keep all their digits. Its covariance with depth is
sum_k c_k o_z e_k, c = 1 / z or (r+ + r-) / sqrt(12): by it depth grows along the image (`splat.slopes_of`). Near the camera plane the
moments of a perspective Gaussian diverge and a splat beside the car would flood the image, so: a sigma point nearer than a share of the
centre's depth (sigma.py), or behind the camera, is projected as if it lay at that share, and n is taken no further out than 1.3 times half
the view. All continuous where it can be seen.
"""

import warp as wp

from render.kernels.sigma import least_depth
from render.kernels.types import HALF, ONE, ROOT3, TWO, View

SIXTH_OF_ROOT3 = wp.constant(wp.float64(3.0**0.5 / 6.0))

vec_axis = wp.types.vector(length=8, dtype=wp.float64)


@wp.struct
class Axis:
    """One principal axis of a splat in the camera and on the image."""

    offset: wp.vec3d
    e: wp.vec2d
    w: wp.float64
    b: wp.float64
    c: wp.float64  # of its covariance with depth
    near_z: wp.float64  # of the sigma point at -sqrt(3), after the clamp
    far_z: wp.float64


@wp.struct
class Footprint:
    """The 2D Gaussian before dilation; det0 is the determinant of its covariance."""

    along: wp.vec2d  # where the centre's ray meets the plane z = 1
    n: wp.vec2d  # where the Jacobian is taken there
    least: wp.float64  # the share of its depth that its sigma points keep
    u: Axis
    v: Axis
    w: Axis
    mu: wp.vec2d
    xx: wp.float64
    xy: wp.float64
    yy: wp.float64
    det0: wp.float64
    xz: wp.float64
    yz: wp.float64
    zz: wp.float64


@wp.func
def cross2(a: wp.vec2d, b: wp.vec2d):
    return a[0] * b[1] - a[1] * b[0]


@wp.func
def project_axis(offset: wp.vec3d, n: wp.vec2d, z: wp.float64, floor: wp.float64, view: View):
    a = Axis()
    a.offset = offset
    a.e = wp.vec2d(view.lens[0] * (offset[0] - n[0] * offset[2]), view.lens[1] * (offset[1] - n[1] * offset[2]))
    if view.unscented == 0:
        a.w = ONE / (z * z)
        a.b = wp.float64(0.0)
        a.c = ONE / z
    else:
        a.far_z = wp.max(z + ROOT3 * offset[2], floor)
        a.near_z = wp.max(z - ROOT3 * offset[2], floor)
        both = ONE / (a.near_z * a.far_z)  # one division for all: they are what takes the time here
        a.w = HALF * (a.near_z * a.near_z + a.far_z * a.far_z) * both * both
        a.b = SIXTH_OF_ROOT3 * (a.near_z - a.far_z) * both
        a.c = HALF * (a.near_z + a.far_z) * both
    return a


@wp.func
def footprint(t: wp.vec3d, axes: wp.mat33d, scale: wp.vec3d, view: View):
    """axes: the splat's principal directions in the camera, as columns; scale in metres."""
    f = Footprint()
    z = t[2]
    f.along = wp.vec2d(t[0] / z, t[1] / z)
    f.n = wp.vec2d(wp.clamp(f.along[0], view.clamp_left, view.clamp_right), wp.clamp(f.along[1], view.clamp_top, view.clamp_bottom))
    f.least = HALF
    if view.unscented != 0:
        f.least = least_depth(f.n, view)
    floor = f.least * z
    f.u = project_axis(scale[0] * wp.vec3d(axes[0, 0], axes[1, 0], axes[2, 0]), f.n, z, floor, view)
    f.v = project_axis(scale[1] * wp.vec3d(axes[0, 1], axes[1, 1], axes[2, 1]), f.n, z, floor, view)
    f.w = project_axis(scale[2] * wp.vec3d(axes[0, 2], axes[1, 2], axes[2, 2]), f.n, z, floor, view)
    f.mu = f.u.b * f.u.e + f.v.b * f.v.e + f.w.b * f.w.e
    f.xx = f.u.w * f.u.e[0] * f.u.e[0] + f.v.w * f.v.e[0] * f.v.e[0] + f.w.w * f.w.e[0] * f.w.e[0] + f.mu[0] * f.mu[0]
    f.xy = f.u.w * f.u.e[0] * f.u.e[1] + f.v.w * f.v.e[0] * f.v.e[1] + f.w.w * f.w.e[0] * f.w.e[1] + f.mu[0] * f.mu[1]
    f.yy = f.u.w * f.u.e[1] * f.u.e[1] + f.v.w * f.v.e[1] * f.v.e[1] + f.w.w * f.w.e[1] * f.w.e[1] + f.mu[1] * f.mu[1]
    f.xz = f.u.c * f.u.offset[2] * f.u.e[0] + f.v.c * f.v.offset[2] * f.v.e[0] + f.w.c * f.w.offset[2] * f.w.e[0]
    f.yz = f.u.c * f.u.offset[2] * f.u.e[1] + f.v.c * f.v.offset[2] * f.v.e[1] + f.w.c * f.w.offset[2] * f.w.e[1]
    f.zz = f.u.offset[2] * f.u.offset[2] + f.v.offset[2] * f.v.offset[2] + f.w.offset[2] * f.w.offset[2]
    uv = cross2(f.u.e, f.v.e)
    uw = cross2(f.u.e, f.w.e)
    vw = cross2(f.v.e, f.w.e)
    um = cross2(f.u.e, f.mu)
    vm = cross2(f.v.e, f.mu)
    wm = cross2(f.w.e, f.mu)
    f.det0 = f.u.w * f.v.w * uv * uv + f.u.w * f.w.w * uw * uw + f.v.w * f.w.w * vw * vw
    f.det0 += f.u.w * um * um + f.v.w * vm * vm + f.w.w * wm * wm
    return f


@wp.func
def cross_gradient(b: wp.vec2d, g: wp.float64):
    """g times d cross2(a, b) / d a; by b it is minus the same with a in place of b."""
    return wp.vec2d(g * b[1], -g * b[0])


@wp.func
def quadratic(xx: wp.float64, xy: wp.float64, yy: wp.float64, v: wp.vec2d):
    return xx * v[0] * v[0] + xy * v[0] * v[1] + yy * v[1] * v[1]


@wp.func
def gradient_of_quadratic(xx: wp.float64, xy: wp.float64, yy: wp.float64, v: wp.vec2d):
    return wp.vec2d(TWO * xx * v[0] + xy * v[1], xy * v[0] + TWO * yy * v[1])


@wp.func
def axis_backward(
    a: Axis, g_e: wp.vec2d, g_w: wp.float64, g_b: wp.float64, by_depth: wp.vec3d,
    n: wp.vec2d, z: wp.float64, least: wp.float64, rise: wp.vec2d, view: View,
):  # fmt: skip
    """d loss / d (offset, n, z, f) packed as a vector of 8; by_depth: that by xz, yz, zz; rise: d least / d n."""
    g_z = wp.float64(0.0)
    g_floor = wp.float64(0.0)
    along = by_depth[0] * a.e[0] + by_depth[1] * a.e[1]
    g_c = along * a.offset[2]
    g_oz = a.c * along + TWO * by_depth[2] * a.offset[2]
    if view.unscented == 0:
        g_z = -TWO * a.w / z * g_w - a.c * a.c * g_c
    else:
        r_far = ROOT3 / a.far_z
        r_near = ROOT3 / a.near_z
        g_far = -(g_w * r_far / wp.float64(3.0) + g_b / wp.float64(6.0)) * r_far / a.far_z - HALF * g_c / (a.far_z * a.far_z)
        g_near = -(g_w * r_near / wp.float64(3.0) - g_b / wp.float64(6.0)) * r_near / a.near_z - HALF * g_c / (a.near_z * a.near_z)
        if z + ROOT3 * a.offset[2] >= least * z:
            g_z += g_far
            g_oz += ROOT3 * g_far
        else:
            g_floor += g_far
        if z - ROOT3 * a.offset[2] >= least * z:
            g_z += g_near
            g_oz -= ROOT3 * g_near
        else:
            g_floor += g_near
        g_z += least * g_floor
    pushed = g_e + a.c * a.offset[2] * wp.vec2d(by_depth[0], by_depth[1])
    gx = view.lens[0] * pushed[0]
    gy = view.lens[1] * pushed[1]
    g_oz -= gx * n[0] + gy * n[1]
    return vec_axis(
        gx, gy, g_oz, z * g_floor * rise[0] - gx * a.offset[2], z * g_floor * rise[1] - gy * a.offset[2], g_z,
        pushed[0] * (a.offset[0] - n[0] * a.offset[2]), pushed[1] * (a.offset[1] - n[1] * a.offset[2]),
    )  # fmt: skip
