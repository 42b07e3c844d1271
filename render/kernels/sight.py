"""Where any lens, under a shutter that may move, sees a splat: its moment, its pixel and its footprint, in float64.

EWA goes by the lens's Jacobian at the centre; the unscented transform (alpha = 1, beta = 2, kappa = 0) by sigma points, with sigma.py's
rules for those that leave the lens's domain.

While a shutter moves, a point's pixel p and the share s of the readout at which it is seen hang together: s = p_axis / extent, with
p = pixel(pose(s) X). Newton's iteration finds s for the centre and every sigma point by itself. Backward differentiates that
equation (implicit function theorem): a gradient g of p acts as g + e (g . v) / (extent - v_axis) at fixed s, where v = dp/ds and e is
the unit vector of the axis. A point that is seen before the first row or after the last has the pose there, and no share.

Offsets are measured from the centre as pulled into 1.3 times the view (`aim`), as project.py does, so that a splat beside the car does
not flood the image.
"""

from functools import cache
from typing import NamedTuple

import warp as wp

from render.kernels.lenses import PLANAR, ROUND, LensFunctions
from render.kernels.lenses.optics import Optics
from render.kernels.motion import Motion, rotation_at, rotation_rate, translation_at, translation_rate
from render.kernels.sigma import ROOT6, determinant, inside, least_depth, mat72d, reach
from render.kernels.splat import Ellipse
from render.kernels.types import FARTHEST, HALF, ROOT3, View

STILL = wp.constant(wp.float64(1.0e-7))
STEPS = wp.constant(50)
SETTLED = wp.constant(wp.float64(1.0e-13))
ENDS = wp.constant(wp.float64(1.0e-9))
ROOT_HALF = wp.constant(wp.float64(0.5**0.5))
AXIS = wp.constant(wp.vec3d(0.0, 0.0, 1.0))
"""The way that depth grows, but of lenses that see all around; and that all rays go of a lens without an eye."""


class SightFunctions(NamedTuple):
    """Of a lens under a global or a moving shutter; what each is stands with it below."""

    readout: wp.Function
    placed: wp.Function
    pixel_backward: wp.Function
    nearest: wp.Function
    outwards: wp.Function
    sighted: wp.Function
    least_of: wp.Function
    spread: wp.Function
    turns: wp.Function
    ellipse: wp.Function


@wp.struct
class Sight:
    """A splat's centre as it is seen: at share s, in the camera at t; `aim` is t pulled into the view."""

    s: wp.float64
    t: wp.vec3d
    rotation: wp.mat33d
    aim: wp.vec3d
    depth: wp.float64
    seen: int


@wp.struct
class Pixels:
    """Where the centre and what it is aimed at fall, the covariance as seven vectors, the last being the mean's shift, by how much farther
    the axes' ends are, and the covariance with that."""

    centre: wp.vec2d
    aimed: wp.vec2d
    v: mat72d
    farther: wp.vec3d
    with_depth: wp.vec2d


@wp.func
def column(m: wp.mat33d, k: int):
    return wp.vec3d(m[0, k], m[1, k], m[2, k])


@wp.func
def perspective(t: wp.vec3d):
    """Where the ray to t meets the plane z = 1."""
    return wp.vec2d(t[0] / t[2], t[1] / t[2])


@wp.func
def pulled(t: wp.vec3d, view: View):
    """t on the same plane z, no further out than 1.3 times half the view."""
    x = wp.clamp(t[0], wp.float64(view.clamp_left) * t[2], wp.float64(view.clamp_right) * t[2])
    y = wp.clamp(t[1], wp.float64(view.clamp_top) * t[2], wp.float64(view.clamp_bottom) * t[2])
    return wp.vec3d(x, y, t[2])


@cache
def sight_functions(lens: LensFunctions, rolling: bool) -> SightFunctions:
    pixel, jacobian, _, depth = lens
    planar, around = depth == PLANAR, depth == ROUND

    @wp.func
    def readout(o: Optics, m: Motion, x: wp.vec3d, shift: wp.vec3d):
        """The share of the readout at which local point x, moved by `shift` in the camera, is seen: the first, where it outruns the shutter
        and is seen twice. Newton's steps are few, but where a lens bends hard beside the view."""
        s = wp.float64(0.0)
        if wp.static(rolling):
            low = wp.float64(0.0)
            high = wp.float64(1.0)
            for _i in range(STEPS):
                last = wp.float64(s)
                y = rotation_at(m, s) * x + translation_at(m, s) + shift
                v = jacobian(o, y) * (rotation_rate(m, s) * x + translation_rate(m, s))
                p = pixel(o, y)
                early = s * m.extent - p[m.axis]
                if early < wp.float64(0.0):
                    low = wp.float64(s)
                else:
                    high = wp.float64(s)
                ahead = m.extent - v[m.axis]  # of the point's pixel; where it outruns the shutter, Newton's step leads away
                s = wp.clamp(s - early / ahead, wp.float64(0.0), wp.float64(1.0))
                if ahead <= wp.float64(0.0) or (s < low and low > wp.float64(0.0)) or (s > high and high < wp.float64(1.0)):
                    s = wp.float64(0.5) * (low + high)
                if wp.abs(s - last) < SETTLED:
                    break
            if s > wp.float64(1.0) - ENDS:
                s = wp.float64(1.0)  # halving comes near the end, where a point that no row meets belongs
        return s

    @wp.func
    def placed(m: Motion, x: wp.vec3d, shift: wp.vec3d, s: wp.float64):
        if wp.static(rolling):
            return rotation_at(m, s) * x + translation_at(m, s) + shift
        return m.r0 * x + m.t0 + shift

    @wp.func
    def pixel_backward(o: Optics, m: Motion, x: wp.vec3d, shift: wp.vec3d, s: wp.float64, g: wp.vec2d, g_s: wp.float64):
        """d loss / d (pixel at fixed s): g, and what g and g_s give through s."""
        if wp.static(rolling):  # noqa: SIM102 - a static branch and a dynamic one
            if s > wp.float64(0.0) and s < wp.float64(1.0):
                y = placed(m, x, shift, s)
                v = jacobian(o, y) * (rotation_rate(m, s) * x + translation_rate(m, s))
                through = (wp.dot(g, v) + g_s) / (m.extent - v[m.axis])
                if m.axis == 0:
                    return wp.vec2d(g[0] + through, g[1])
                return wp.vec2d(g[0], g[1] + through)
        return wp.vec2d(g[0], g[1])

    @wp.func
    def nearest(o: Optics, along: wp.float64):
        """Whole turns to take off a step along x that crosses the seam."""
        if o.period > wp.float64(0.0):
            return wp.round(along / o.period)
        return wp.float64(0.0)

    @wp.func
    def far(y: wp.vec3d):
        """A point's depth, as this lens has it."""
        if wp.static(around):
            return wp.length(y)
        return y[2]

    @wp.func
    def outwards(t: wp.vec3d):
        """What a point's depth grows by, as it moves in the camera."""
        if wp.static(around):
            return wp.normalize(t)
        return AXIS

    @wp.func
    def sighted(o: Optics, m: Motion, x: wp.vec3d, view: View):
        c = Sight()
        c.s = readout(o, m, x, wp.vec3d())
        c.t = placed(m, x, wp.vec3d(), c.s)
        c.rotation = m.r0
        if wp.static(rolling):
            c.rotation = rotation_at(m, c.s)
        c.aim = c.t
        c.depth = far(c.t)
        if wp.static(planar):
            c.aim = pulled(c.t, view)
        c.seen = int(0)
        if c.depth > wp.float64(view.near) and wp.length(c.t) < wp.float64(FARTHEST) and inside(o, c.t):
            c.seen = int(1)
            if wp.static(rolling):
                p = pixel(o, c.t)
                if wp.abs(wp.clamp(p[m.axis] / m.extent, wp.float64(0.0), wp.float64(1.0)) - c.s) > STILL:
                    c.seen = int(0)  # moves too fast for one place on the image
                nearest_by = wp.min(far(placed(m, x, wp.vec3d(), wp.float64(0.0))), far(placed(m, x, wp.vec3d(), wp.float64(1.0))))
                if nearest_by <= wp.float64(view.near):
                    c.seen = int(0)  # the camera drives through it
        return c

    @wp.func
    def least_of(c: Sight, view: View):
        """The share of its depth that a splat's sigma points keep."""
        if wp.static(planar):
            return least_depth(perspective(c.aim), view)
        return HALF

    @wp.func
    def spread(o: Optics, m: Motion, x: wp.vec3d, axes: wp.mat33d, c: Sight, view: View):
        """axes: the splat's scaled axes in its local frame, as columns."""
        out = Pixels()
        out.centre = pixel(o, c.t)
        shift = c.aim - c.t
        out.farther = wp.transpose(axes) * (wp.transpose(c.rotation) * outwards(c.t))
        if view.unscented == 0:
            j = jacobian(o, c.aim)
            for k in range(3):
                e = j * (c.rotation * column(axes, k))
                out.v[k, 0] = e[0]
                out.v[k, 1] = e[1]
                out.with_depth += out.farther[k] * e
        else:
            least = least_of(c, view)
            s = readout(o, m, x, shift)
            out.aimed = pixel(o, placed(m, x, shift, s))
            for i in range(6):
                local = column(axes, i // 2)
                if i % 2 == 1:
                    local = -local
                r = reach(o, c.aim, c.rotation * local, wp.static(depth), least)
                point = x + r.tau * local
                s = readout(o, m, point, shift)
                d = pixel(o, placed(m, point, shift, s)) - out.aimed
                stretch = ROOT3 / r.tau
                dx = (d[0] - nearest(o, d[0]) * o.period) * stretch
                dy = d[1] * stretch
                out.v[i, 0] = dx / ROOT6
                out.v[i, 1] = dy / ROOT6
                out.v[6, 0] = out.v[6, 0] + dx / wp.float64(6.0)
                out.v[6, 1] = out.v[6, 1] + dy / wp.float64(6.0)
                sign = ROOT_HALF
                if i % 2 == 1:
                    sign = -sign
                out.with_depth += sign * out.farther[i // 2] * wp.vec2d(out.v[i, 0], out.v[i, 1])
        return out

    @wp.func
    def turns(o: Optics, m: Motion, x: wp.float64):
        """Whole turns by which a splat is moved to where the picture is, or its copy to the picture's other side, across the seam."""
        whole = nearest(o, o.middle - x)
        if m.copy == 0:
            return whole
        if x + whole * o.period < o.middle:
            return whole + wp.float64(1.0)
        return whole - wp.float64(1.0)

    @wp.func
    def ellipse(o: Optics, m: Motion, q: Pixels):
        e = Ellipse()
        xx = wp.float64(0.0)
        xy = wp.float64(0.0)
        yy = wp.float64(0.0)
        for i in range(7):
            xx += q.v[i, 0] * q.v[i, 0]
            xy += q.v[i, 0] * q.v[i, 1]
            yy += q.v[i, 1] * q.v[i, 1]
        x = q.centre[0] + q.v[6, 0]
        e.x = x + turns(o, m, x) * o.period
        e.y = q.centre[1] + q.v[6, 1]
        e.xx = xx
        e.xy = xy
        e.yy = yy
        e.det0 = determinant(q.v)
        e.xz = q.with_depth[0]
        e.yz = q.with_depth[1]
        e.zz = wp.dot(q.farther, q.farther)
        return e

    return SightFunctions(readout, placed, pixel_backward, nearest, outwards, sighted, least_of, spread, turns, ellipse)
