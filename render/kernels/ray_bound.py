"""Where on the image a splat can be seen along rays, as an ellipse around it; in float64.

A ray sees a splat within exponent s_max where it meets the ellipsoid of sqrt(2 s_max) sigma, so what the image shows is the outline of
that ellipsoid. A pinhole's is an ellipse, by its dual conic: in coordinates that move with the centre's ray it is
rho^2 Sigma' - diag(0, 0, z^2), rho^2 = 2 s_max, of which nothing cancels. Another lens, or a shutter that moves, takes the circle in which
the cone from the eye touches the ellipsoid to a curve; the bound goes around points of it, with room. What reaches around the eye, past
the lens's domain or far beside the view may be seen everywhere.
"""

from functools import cache

import warp as wp

from render.kernels.lenses import PARALLEL, PLANAR, ROUND, LensFunctions
from render.kernels.lenses.optics import Optics
from render.kernels.motion import Motion
from render.kernels.sight import Sight, column, sight_functions
from render.kernels.sigma import inside
from render.kernels.splat import Ellipse
from render.kernels.types import TILE, View

ANYWHERE = wp.constant(1.0e9)
"""Pixels from its middle within which a splat is seen that no seam hides."""
POINTS = wp.constant(16)
vec_points = wp.types.vector(length=16, dtype=wp.float64)
SHARE = wp.constant(wp.float64(1 / 16))
STEP = wp.constant(wp.float64(0.39269908169872414))  # of the circle, in radians
ROOM_STILL = 1.15
"""Of the squared extents: an ellipse through 16 of its points misses up to 1.04; the rest is for lenses that bend it."""
ROOM_MOVING = 1.6
QUARTER = wp.constant(wp.float64(0.25))
NEARLY = wp.constant(wp.float64(1.0e-6))
WIDE = wp.constant(
    wp.float64(0.9)
)  # cosine of how far from its centre a splat reaches, of which lenses that see all around make no ellipse
FLOOR = wp.constant(wp.float64(0.25))  # px^2, since a needle seen from its end has no width
TILE_SIZE = wp.constant(wp.float64(TILE))


@wp.func
def everywhere(s_max: float, view: View):
    """An ellipse around all that is drawn."""
    half = wp.float64(0.5)
    e = Ellipse()
    e.x = (wp.float64(view.tile_left) + half * wp.float64(view.tiles_x)) * TILE_SIZE
    e.y = (wp.float64(view.tile_top) + half * wp.float64(view.tiles_y)) * TILE_SIZE
    side = wp.float64(view.tiles_x + view.tiles_y) * TILE_SIZE
    e.xx = half * side * side / wp.float64(s_max)
    e.yy = e.xx
    e.det0 = e.xx * e.yy
    e.seen = ANYWHERE
    return e


@wp.func
def ellipse_of(x: wp.float64, y: wp.float64, xx: wp.float64, xy: wp.float64, yy: wp.float64, seen: wp.float64):
    e = Ellipse()
    e.x = x
    e.y = y
    e.xx = xx
    e.xy = xy
    e.yy = yy
    e.det0 = wp.max(xx * yy - xy * xy, wp.float64(0.0))
    e.seen = float(seen)
    return e


@wp.func
def pinhole_bound(t: wp.vec3d, axes: wp.mat33d, s_max: float, view: View):
    """t, axes: centre and scaled principal axes, as columns, in the camera."""
    rho2 = wp.float64(2.0) * wp.float64(s_max)
    zz = axes[2, 0] * axes[2, 0] + axes[2, 1] * axes[2, 1] + axes[2, 2] * axes[2, 2]
    ahead = t[2] * t[2] - rho2 * zz
    if ahead <= NEARLY * t[2] * t[2]:
        return everywhere(s_max, view)
    nx = t[0] / t[2]
    ny = t[1] / t[2]
    xx = wp.float64(0.0)
    xy = wp.float64(0.0)
    yy = wp.float64(0.0)
    xz = wp.float64(0.0)
    yz = wp.float64(0.0)
    for k in range(3):
        ex = view.lens[0] * (axes[0, k] - nx * axes[2, k])
        ey = view.lens[1] * (axes[1, k] - ny * axes[2, k])
        xx += ex * ex
        xy += ex * ey
        yy += ey * ey
        xz += ex * axes[2, k]
        yz += ey * axes[2, k]
    mx = -xz / ahead  # of the ellipse's middle, times 1 / rho^2
    my = -yz / ahead
    return ellipse_of(
        view.lens[0] * nx + view.lens[2] + rho2 * mx, view.lens[1] * ny + view.lens[3] + rho2 * my,
        xx / ahead + rho2 * mx * mx, xy / ahead + rho2 * mx * my, yy / ahead + rho2 * my * my, wp.float64(ANYWHERE),
    )  # fmt: skip


@wp.func
def beside(y: wp.vec3d, view: View):
    """Whether a point before the camera lies beyond 1.3 times half the view. Distortion says nothing there, and of an outline that runs
    away to the side few points show where it comes by."""
    x_out = y[0] < wp.float64(view.clamp_left) * y[2] or y[0] > wp.float64(view.clamp_right) * y[2]
    return x_out or y[1] < wp.float64(view.clamp_top) * y[2] or y[1] > wp.float64(view.clamp_bottom) * y[2]


@cache
def lens_bound(lens: LensFunctions, rolling: bool):
    """The function that bounds a splat for a lens under a global or a moving shutter."""
    pixel, _, _, depth = lens
    readout, placed, _, nearest, _, _, _, _, turns, _ = sight_functions(lens, rolling)
    room = ROOM_MOVING if rolling else ROOM_STILL

    @wp.func
    def bound(o: Optics, m: Motion, x: wp.vec3d, axes: wp.mat33d, c: Sight, s_max: float, view: View):
        """axes: the splat's scaled axes in its local frame, as columns."""
        one = wp.float64(1.0)
        rho2 = wp.float64(2.0) * wp.float64(s_max)
        # the eye, or where it lies, in the frame in which the ellipsoid is a sphere
        eye = wp.vec3d()
        sight = c.t
        if wp.static(depth == PARALLEL):
            sight = wp.vec3d(wp.float64(0.0), wp.float64(0.0), one)
        for k in range(3):
            a = c.rotation * column(axes, k)
            eye[k] = -wp.dot(a, sight) / wp.max(wp.dot(a, a), wp.float64(1.0e-60))
        away = wp.length(eye)
        n = eye / away
        offset = wp.float64(0.0)
        radius = wp.sqrt(rho2)
        if wp.static(depth != PARALLEL):
            if away * away <= rho2 * (one + NEARLY):
                return everywhere(s_max, view)
            offset = rho2 / away
            radius = wp.sqrt(rho2 * (one - rho2 / (away * away)))
        side = wp.vec3d(one, wp.float64(0.0), wp.float64(0.0))
        if wp.abs(n[0]) > wp.float64(0.7):
            side = wp.vec3d(wp.float64(0.0), one, wp.float64(0.0))
        u = wp.normalize(wp.cross(n, side))
        v = wp.cross(n, u)
        at = pixel(o, c.t)
        sx = wp.float64(0.0)
        sy = wp.float64(0.0)
        sxx = wp.float64(0.0)
        sxy = wp.float64(0.0)
        syy = wp.float64(0.0)
        px = vec_points()
        py = vec_points()
        for i in range(POINTS):
            angle = wp.float64(i) * STEP
            q = offset * n + radius * (wp.cos(angle) * u + wp.sin(angle) * v)
            point = x + axes * q
            s = readout(o, m, point, wp.vec3d())
            y = placed(m, point, wp.vec3d(), s)
            if not inside(o, y) or (wp.static(depth == PLANAR) and (y[2] <= NEARLY * c.t[2] or beside(y, view))):
                return everywhere(s_max, view)
            d = pixel(o, y) - at
            dx = d[0] - nearest(o, d[0]) * o.period
            if wp.static(depth == ROUND):
                high = o.period > wp.float64(0.0) and wp.abs(dx) > QUARTER * o.period  # around a pole
                if high or wp.dot(y, c.t) < WIDE * wp.length(y) * wp.length(c.t):
                    return everywhere(s_max, view)
            px[i] = dx
            py[i] = d[1]
            sx += dx
            sy += d[1]
            sxx += dx * dx
            sxy += dx * d[1]
            syy += d[1] * d[1]
        sx *= SHARE
        sy *= SHARE
        xx = wp.float64(2.0) * (sxx * SHARE - sx * sx) + FLOOR
        xy = wp.float64(2.0) * (sxy * SHARE - sx * sy)
        yy = wp.float64(2.0) * (syy * SHARE - sy * sy) + FLOOR
        det = xx * yy - xy * xy
        widest = one
        for i in range(POINTS):
            dx = px[i] - sx
            dy = py[i] - sy
            widest = wp.max(widest, (yy * dx * dx - wp.float64(2.0) * xy * dx * dy + xx * dy * dy) / det)
        scale = widest * wp.float64(wp.static(room)) / rho2
        seen = wp.float64(ANYWHERE)
        if o.period > wp.float64(0.0):
            seen = wp.float64(0.5) * o.period
        middle = at[0] + sx
        return ellipse_of(middle + turns(o, m, middle) * o.period, at[1] + sy, scale * xx, scale * xy, scale * yy, seen)

    return bound
