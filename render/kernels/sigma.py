"""How far a sigma point may go, and the covariance of what the sigma points give, for any lens; in float64.

A sigma point at +-sqrt(3) along an axis that would come nearer than a share of the centre's depth, or leave the lens's domain, is pulled
back to where it would, at tau < sqrt(3), and what it moves the pixel by is stretched by sqrt(3) / tau. So nothing behind the camera
or past the fold-over enters the moments, and they stay continuous: as tau goes to 0 they become EWA's. For a pinhole this is the
clamp of moments.py.

That share is a half. Of a lens that sees what lies before it, it grows beside the view, to 1 where the centre is no further followed
(1.3 times half the view): the ground beside a wide camera would flood the image from half its depth.
"""

import warp as wp

from render.kernels.lenses import PLANAR, ROUND
from render.kernels.lenses.optics import Optics
from render.kernels.types import HALF, ONE, ROOT3, View

ROOT6 = wp.constant(wp.float64(2.449489742783178))
LEAST = wp.constant(wp.float64(1.0e-6))
RISE = wp.constant(wp.float64(0.5 / 0.3))  # of the share, from a half at the view's sides to 1 at 1.3 times half the view
FULL, AT_DEPTH, AT_EDGE = (wp.constant(i) for i in range(3))
_PLANAR, _ROUND = wp.constant(PLANAR), wp.constant(ROUND)

mat72d = wp.types.matrix(shape=(7, 2), dtype=wp.float64)


@wp.struct
class Reach:
    """tau, and what set it."""

    tau: wp.float64
    rule: int


@wp.struct
class ReachGradient:
    centre: wp.vec3d
    offset: wp.vec3d
    least: wp.float64


@wp.func
def half_views(n: wp.vec2d, view: View):
    """How far out a ray through n on the plane z = 1 lies, in half views: 1 at the view's sides."""
    return wp.vec2d(view.per_half[0] * (n[0] - view.middle[0]), view.per_half[1] * (n[1] - view.middle[1]))


@wp.func
def least_depth(n: wp.vec2d, view: View):
    """The share of its depth that the sigma points keep of a splat whose centre lies on the ray through n on the plane z = 1."""
    out = half_views(n, view)
    if wp.abs(out[0]) <= ONE and wp.abs(out[1]) <= ONE:
        return HALF
    return wp.min(HALF + RISE * (wp.max(wp.abs(out[0]), wp.abs(out[1])) - ONE), ONE)


@wp.func
def least_depth_gradient(n: wp.vec2d, view: View):
    """d least_depth / d n, up to the clamp."""
    out = half_views(n, view)
    g = wp.vec2d()
    k = int(0)
    if wp.abs(out[1]) > wp.abs(out[0]):
        k = int(1)
    if wp.abs(out[k]) > ONE:
        g[k] = RISE * view.per_half[k] * wp.sign(out[k])
    return g


@wp.func
def inside(o: Optics, v: wp.vec3d):
    return v[2] > o.cos_limit * wp.length(v)


@wp.func
def at_edge(o: Optics, centre: wp.vec3d, offset: wp.vec3d, tau: wp.float64):
    """The least share of `offset` at which it crosses the domain's cone; `tau` where it does not."""
    cc = o.cos_limit * o.cos_limit
    ss = o.sin_limit * o.sin_limit
    a = cc * (offset[0] * offset[0] + offset[1] * offset[1]) - ss * offset[2] * offset[2]
    b = cc * (centre[0] * offset[0] + centre[1] * offset[1]) - ss * centre[2] * offset[2]
    c = cc * (centre[0] * centre[0] + centre[1] * centre[1]) - ss * centre[2] * centre[2]
    zero = wp.float64(0.0)
    root = wp.sqrt(wp.max(b * b - a * c, zero))
    w = -(b + root)
    if b < zero:
        w = -(b - root)
    first = w / a
    second = c / w
    out = wp.float64(tau)
    # written so that a NaN changes nothing
    if first > zero and first < out and (centre[2] + first * offset[2]) * o.cos_limit >= zero:
        out = wp.float64(first)
    if second > zero and second < out and (centre[2] + second * offset[2]) * o.cos_limit >= zero:
        out = wp.float64(second)
    return out


@wp.func
def reach(o: Optics, centre: wp.vec3d, offset: wp.vec3d, depth: int, least: wp.float64):
    """How far a sigma point goes from `centre` along `offset` (one sigma). depth: which the lens has; least: the share of it to keep."""
    out = Reach()
    out.tau = ROOT3
    out.rule = FULL
    room = wp.float64(0.0)
    rate = wp.float64(-1.0)
    if depth == _PLANAR:
        room = (ONE - least) * centre[2]
        rate = -offset[2]
    if depth == _ROUND:
        room = (ONE - least) * wp.dot(centre, centre)
        rate = -wp.dot(centre, offset)
    if rate * ROOT3 > room:
        out.tau = wp.max(room / rate, LEAST)
        out.rule = AT_DEPTH
    if not inside(o, centre + out.tau * offset) and inside(o, centre):
        tau = at_edge(o, centre, offset, out.tau)
        if tau < out.tau:
            out.tau = wp.max(tau, LEAST)
            out.rule = AT_EDGE
    return out


@wp.func
def reach_backward(o: Optics, centre: wp.vec3d, offset: wp.vec3d, depth: int, tau: wp.float64, rule: int, g: wp.float64):
    out = ReachGradient()
    two = wp.float64(2.0)
    zero = wp.float64(0.0)
    if rule == AT_DEPTH:
        if depth == _PLANAR:
            out.least = g * centre[2] / offset[2]
            out.centre = wp.vec3d(zero, zero, g * tau / centre[2])
            out.offset = wp.vec3d(zero, zero, -g * tau / offset[2])
        else:
            along = wp.dot(centre, offset)
            out.centre = (g * tau) * (two * centre / wp.dot(centre, centre) - offset / along)
            out.offset = (-g * tau / along) * centre
    if rule == AT_EDGE:
        edge = centre + tau * offset
        cc = o.cos_limit * o.cos_limit
        n = wp.vec3d(cc * edge[0], cc * edge[1], -o.sin_limit * o.sin_limit * edge[2])
        out.centre = (-g / wp.dot(n, offset)) * n
        out.offset = tau * out.centre
    return out


@wp.func
def crossed(v: mat72d, i: int, j: int):
    return v[i, 0] * v[j, 1] - v[i, 1] * v[j, 0]


@wp.func
def determinant(v: mat72d):
    """det of the sum of v_i v_i', by Cauchy-Binet a sum of squares, which does not cancel."""
    out = wp.float64(0.0)
    for i in range(7):
        for j in range(i):
            c = crossed(v, i, j)
            out += c * c
    return out


@wp.func
def covariance_backward(v: mat72d, g_xx: wp.float64, g_xy: wp.float64, g_yy: wp.float64, g_det: wp.float64):
    """d loss / d v from that by covariance and determinant."""
    two = wp.float64(2.0)
    out = mat72d()
    for i in range(7):
        gx = two * g_xx * v[i, 0] + g_xy * v[i, 1]
        gy = two * g_yy * v[i, 1] + g_xy * v[i, 0]
        for j in range(7):
            c = two * g_det * crossed(v, i, j)
            gx += c * v[j, 1]
            gy -= c * v[j, 0]
        out[i, 0] = gx
        out[i, 1] = gy
    return out
