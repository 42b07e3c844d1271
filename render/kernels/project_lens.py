"""Any lens, and shutters that move: a splat in space becomes a record, and its gradient's way back, in float64.

As project.py, with the lens's own functions in place of the pinhole's closed forms: EWA by its Jacobian at the centre; the unscented
transform (alpha = 1, beta = 2, kappa = 0) by sigma points, with sigma.py's rules for those that leave the lens's domain.

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

from render.kernels.fields import exp_scale, rotation, rotation_backward, sigmoid
from render.kernels.lenses import PLANAR, ROUND, LensFunctions
from render.kernels.lenses.optics import PARAMS, Optics, params
from render.kernels.motion import Motion, rotation_at, rotation_rate, translation_at, translation_rate
from render.kernels.project import in_view
from render.kernels.sigma import (
    ROOT3,
    ROOT6,
    covariance_backward,
    determinant,
    inside,
    mat72d,
    reach,
    reach_backward,
)
from render.kernels.splat import Ellipse, colour_backward, cull, gather, no_gradient, write_splat
from render.kernels.types import FARTHEST, OPTIONS, View

ROLLED = OPTIONS | {"max_unroll": 0}
POSE = 12
"""Numbers of one power's rotation (row major) and translation."""

STILL = wp.constant(wp.float64(1.0e-7))
TURN = wp.constant(wp.float64(6.283185307179586))
STEP = wp.constant(wp.float64(1.0e-5))
STEPS = wp.constant(50)
SETTLED = wp.constant(wp.float64(1.0e-13))
ENDS = wp.constant(wp.float64(1.0e-9))


class LensKernels(NamedTuple):
    """The kernels of one lens under one kind of shutter."""

    forward: wp.Kernel
    backward: wp.Kernel


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
    """Where the centre and what it is aimed at fall, and the covariance as seven vectors, the last being the mean's shift."""

    centre: wp.vec2d
    aimed: wp.vec2d
    v: mat72d


@wp.func
def column(m: wp.mat33d, k: int):
    return wp.vec3d(m[0, k], m[1, k], m[2, k])


@wp.func
def to_double(m: wp.mat33):
    return wp.mat33d(m)


@wp.func
def write_pose(g_uniform: wp.array2d[float], part: int, power: int, rotation: wp.mat33d, translation: wp.vec3d):
    for a in range(3):
        for b in range(3):
            g_uniform[part, power * POSE + a * 3 + b] = float(rotation[a, b])
        g_uniform[part, power * POSE + 9 + a] = float(translation[a])


@wp.func
def pulled(t: wp.vec3d, view: View):
    """t on the same plane z, no further out than 1.3 times half the view."""
    x = wp.clamp(t[0], wp.float64(view.clamp_left) * t[2], wp.float64(view.clamp_right) * t[2])
    y = wp.clamp(t[1], wp.float64(view.clamp_top) * t[2], wp.float64(view.clamp_bottom) * t[2])
    return wp.vec3d(x, y, t[2])


@wp.func
def pulled_backward(t: wp.vec3d, aim: wp.vec3d, g: wp.vec3d):
    gx = wp.float64(g[0])
    gy = wp.float64(g[1])
    gz = wp.float64(g[2])
    if aim[0] != t[0]:
        gz += gx * aim[0] / t[2]
        gx = wp.float64(0.0)
    if aim[1] != t[1]:
        gz += gy * aim[1] / t[2]
        gy = wp.float64(0.0)
    return wp.vec3d(gx, gy, gz)


@cache
def lens_kernels(lens: LensFunctions, rolling: bool) -> LensKernels:
    """The kernels of a lens under a global or a moving shutter."""
    pixel, jacobian, params_gradient, depth = lens
    planar, around = depth == PLANAR, depth == ROUND

    @wp.func
    def readout(o: Optics, m: Motion, x: wp.vec3d, shift: wp.vec3d, start: wp.float64):
        """The share of the readout at which local point x, moved by `shift` in the camera, is seen. Newton's steps are few, but where a
        lens bends hard beside the view."""
        s = wp.float64(start)
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
                s = wp.clamp(s - early / (m.extent - v[m.axis]), wp.float64(0.0), wp.float64(1.0))
                if (s < low and low > wp.float64(0.0)) or (s > high and high < wp.float64(1.0)):
                    s = wp.float64(0.5) * (low + high)  # past what was looked at already: a point that comes near fast
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
    def sighted(o: Optics, m: Motion, x: wp.vec3d, view: View):
        c = Sight()
        c.s = readout(o, m, x, wp.vec3d(), wp.float64(0.5))
        c.t = placed(m, x, wp.vec3d(), c.s)
        c.rotation = m.r0
        if wp.static(rolling):
            c.rotation = rotation_at(m, c.s)
        c.aim = c.t
        c.depth = c.t[2]
        if wp.static(planar):
            c.aim = pulled(c.t, view)
        if wp.static(around):
            c.depth = wp.length(c.t)
        c.seen = int(0)
        if c.depth > wp.float64(view.near) and wp.length(c.t) < wp.float64(FARTHEST) and inside(o, c.t):
            c.seen = int(1)
            if wp.static(rolling):
                p = pixel(o, c.t)
                if wp.abs(wp.clamp(p[m.axis] / m.extent, wp.float64(0.0), wp.float64(1.0)) - c.s) > STILL:
                    c.seen = int(0)  # moves too fast for one place on the image
        return c

    @wp.func
    def spread(o: Optics, m: Motion, x: wp.vec3d, axes: wp.mat33d, c: Sight, unscented: int):
        """axes: the splat's scaled axes in its local frame, as columns."""
        out = Pixels()
        out.centre = pixel(o, c.t)
        shift = c.aim - c.t
        if unscented == 0:
            j = jacobian(o, c.aim)
            for k in range(3):
                e = j * (c.rotation * column(axes, k))
                out.v[k, 0] = e[0]
                out.v[k, 1] = e[1]
        else:
            s = readout(o, m, x, shift, c.s)
            out.aimed = pixel(o, placed(m, x, shift, s))
            for i in range(6):
                local = column(axes, i // 2)
                if i % 2 == 1:
                    local = -local
                r = reach(o, c.aim, c.rotation * local, wp.static(depth))
                point = x + r.tau * local
                s = readout(o, m, point, shift, c.s)
                d = pixel(o, placed(m, point, shift, s)) - out.aimed
                stretch = ROOT3 / r.tau
                dx = (d[0] - nearest(o, d[0]) * o.period) * stretch
                dy = d[1] * stretch
                out.v[i, 0] = dx / ROOT6
                out.v[i, 1] = dy / ROOT6
                out.v[6, 0] = out.v[6, 0] + dx / wp.float64(6.0)
                out.v[6, 1] = out.v[6, 1] + dy / wp.float64(6.0)
        return out

    @wp.func
    def turns(o: Optics, m: Motion, x: wp.float64):
        """Whole turns by which a copy stands beside its original, across the seam."""
        if m.copy == 0:
            return wp.float64(0.0)
        if x < o.p[2]:
            return wp.float64(1.0)
        return wp.float64(-1.0)

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
        e.x = float(x + turns(o, m, x) * o.period)
        e.y = float(q.centre[1] + q.v[6, 1])
        e.xx = float(xx)
        e.xy = float(xy)
        e.yy = float(yy)
        e.det0 = float(determinant(q.v))
        return e

    @wp.func
    def scaled_axes(quat: wp.vec4, log_scale: wp.vec3):
        return to_double(rotation(quat) * wp.diag(exp_scale(log_scale)))

    @wp.kernel(module="unique", module_options=ROLLED, enable_backward=False)
    def project_lens(
        means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
        logit_opacities: wp.array[float], sh: wp.array2d[wp.vec3],
        view: View, optics: Optics, motion: Motion, base: int,
        records: wp.array2d[float], reach: wp.array2d[int], depth_keys: wp.array[int], counts: wp.array[int],
        first: int,
    ):  # fmt: skip
        """As `project`."""
        i = first + wp.tid()
        j = base + i
        cull(depth_keys, counts, j)
        opacity = sigmoid(logit_opacities[i])
        x = wp.vec3d(means[i])
        c = sighted(optics, motion, x, view)
        if c.seen == 1 and opacity > view.least_opacity:
            axes = scaled_axes(quats[i], log_scales[i])
            ahead = bool(True)
            if wp.static(planar):
                ahead = in_view(wp.vec3(c.t), wp.mat33(c.rotation * axes), wp.vec3(1.0), view)
            if ahead:
                e = ellipse(optics, motion, spread(optics, motion, x, axes, c, view.unscented))
                sight = wp.vec3(wp.transpose(c.rotation) * c.t)
                write_splat(e, opacity, float(c.depth), motion.instance, sh, i, sight, view, records, reach, depth_keys, counts, j)

    @wp.kernel(module="unique", module_options=ROLLED, enable_backward=False)
    def project_lens_backward(
        means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
        logit_opacities: wp.array[float], sh: wp.array2d[wp.vec3],
        view: View, optics: Optics, motion: Motion, base: int, n_splats: int, chunk: int,
        counts: wp.array[int], starts: wp.array[int], slots: wp.array2d[float],
        g_means: wp.array[wp.vec3], g_quats: wp.array[wp.vec4], g_log_scales: wp.array[wp.vec3],
        g_logit_opacities: wp.array[float], g_sh: wp.array2d[wp.vec3], g_uniform: wp.array2d[float],
        first: int,
    ):  # fmt: skip
        """As `project_backward`; g_uniform: POSE numbers for each power of s, then the lens's parameters."""
        part = first + wp.tid()
        g_r0 = wp.mat33d()  # of the pose's coefficients, and of the lens
        g_r1 = wp.mat33d()
        g_r2 = wp.mat33d()
        g_r3 = wp.mat33d()
        g_t0 = wp.vec3d()
        g_t1 = wp.vec3d()
        g_t2 = wp.vec3d()
        g_t3 = wp.vec3d()
        g_lens = params()
        one = wp.float64(1.0)
        none = wp.float64(0.0)
        for i in range(part * chunk, wp.min(part * chunk + chunk, n_splats)):
            j = base + i
            if counts[j] == 0:
                no_gradient(i, view.sh_count, g_means, g_quats, g_log_scales, g_logit_opacities, g_sh)
            else:
                x = wp.vec3d(means[i])
                c = sighted(optics, motion, x, view)
                axes = scaled_axes(quats[i], log_scales[i])
                q = spread(optics, motion, x, axes, c, view.unscented)
                e = ellipse(optics, motion, q)
                g = gather(e, sigmoid(logit_opacities[i]), view, slots, starts[j], counts[j])
                g_logit_opacities[i] = g.logit
                g_mean_px = wp.vec2d(wp.float64(g.x), wp.float64(g.y))
                g_v = covariance_backward(q.v, wp.float64(g.xx), wp.float64(g.xy), wp.float64(g.yy), wp.float64(g.det0))
                shift = c.aim - c.t

                g_x = wp.vec3d()
                g_axes = wp.mat33d()
                g_rotation = wp.mat33d()  # of the centre's own pose, beyond what its point gives
                g_aim = wp.vec3d()  # explicit
                g_shift = wp.vec3d()
                g_turns = turns(optics, motion, q.centre[0] + q.v[6, 0]) * g_mean_px[0]
                if view.unscented == 0:
                    jac = jacobian(optics, c.aim)
                    for k in range(3):
                        o = c.rotation * column(axes, k)
                        g_e = wp.vec2d(g_v[k, 0], g_v[k, 1])
                        g_o = wp.transpose(jac) * g_e
                        g_rotation += wp.outer(g_o, column(axes, k))
                        g_local = wp.transpose(c.rotation) * g_o
                        for a in range(3):
                            g_axes[a, k] = g_axes[a, k] + g_local[a]
                        # the derivative of g_e . J(aim) o, which is that of J' g_e and of the parameters' gradient along o
                        h = STEP * c.depth / wp.max(wp.length(o), wp.float64(1.0e-30))
                        ahead = c.aim + h * o
                        behind = c.aim - h * o
                        over = one / (wp.float64(2.0) * h)
                        g_aim += over * (wp.transpose(jacobian(optics, ahead)) * g_e - wp.transpose(jacobian(optics, behind)) * g_e)
                        g_lens += over * (params_gradient(optics, ahead, g_e) - params_gradient(optics, behind, g_e))
                else:
                    g_aimed = wp.vec2d()
                    g_shared = (g_mean_px + wp.vec2d(g_v[6, 0], g_v[6, 1])) / wp.float64(6.0)
                    for k in range(7):  # the sigma points, then what they are measured from
                        local = wp.vec3d()
                        tau = wp.float64(0.0)
                        rule = int(0)
                        stretch = wp.float64(1.0)
                        if k < 6:
                            local = column(axes, k // 2)
                            if k % 2 == 1:
                                local = -local
                            r = reach(optics, c.aim, c.rotation * local, wp.static(depth))
                            tau = wp.float64(r.tau)
                            rule = int(r.rule)
                            stretch = ROOT3 / r.tau
                        point = x + tau * local
                        s = readout(optics, motion, point, shift, c.s)
                        y = placed(motion, point, shift, s)
                        g_d = wp.vec2d(g_aimed)
                        if k < 6:
                            g_d = (wp.vec2d(g_v[k, 0], g_v[k, 1]) / ROOT6 + g_shared) * stretch
                            g_aimed -= g_d
                            g_turns -= nearest(optics, pixel(optics, y)[0] - q.aimed[0]) * g_d[0]
                        g_p = pixel_backward(optics, motion, point, shift, s, g_d, none)
                        g_y = wp.transpose(jacobian(optics, y)) * g_p
                        g_lens += params_gradient(optics, y, g_p)
                        by_pose = wp.outer(g_y, point)
                        g_r0 += by_pose
                        g_t0 += g_y
                        turn = wp.mat33d(motion.r0)
                        if wp.static(rolling):
                            turn = rotation_at(motion, s)
                            g_r1 += s * by_pose
                            g_t1 += s * g_y
                            g_r2 += s * s * by_pose
                            g_t2 += s * s * g_y
                            g_r3 += s * s * s * by_pose
                            g_t3 += s * s * s * g_y
                        g_shift += g_y
                        g_point = wp.transpose(turn) * g_y
                        g_x += g_point
                        g_local = tau * g_point
                        if rule != 0:
                            # d stretch hangs on tau through the point and through the stretch
                            o = c.rotation * local
                            d = wp.vec2d(q.v[k, 0], q.v[k, 1]) * (ROOT6 / stretch)
                            g_tau = wp.dot(g_point, local) - wp.dot(g_d, d) / tau
                            back = reach_backward(optics, c.aim, o, wp.static(depth), tau, rule, g_tau)
                            g_aim += back.centre
                            g_rotation += wp.outer(back.offset, local)
                            g_local += wp.transpose(c.rotation) * back.offset
                        if k % 2 == 1:
                            g_local = -g_local
                        if k < 6:
                            for a in range(3):
                                g_axes[a, k // 2] = g_axes[a, k // 2] + g_local[a]

                # the centre: what hangs on t beside its pixel, then the pixel
                g_aim += g_shift
                g_t = g_aim - g_shift
                if wp.static(planar):
                    g_t = pulled_backward(c.t, c.aim, g_aim) - g_shift
                if wp.static(around):
                    g_t += (wp.float64(g.depth) / c.depth) * c.t
                else:
                    g_t += wp.vec3d(none, none, wp.float64(g.depth))
                sight = wp.vec3(wp.transpose(c.rotation) * c.t)
                g_sight = wp.vec3d(colour_backward(sh, i, view.sh_count, sight, g.rgb, g_sh))
                g_t += c.rotation * g_sight
                g_rotation += wp.outer(c.t, g_sight)
                g_s = wp.float64(0.0)
                if wp.static(rolling):
                    rate = rotation_rate(motion, c.s)
                    g_s = wp.dot(g_t, rate * x + translation_rate(motion, c.s)) + wp.ddot(g_rotation, rate)
                g_p = pixel_backward(optics, motion, x, wp.vec3d(), c.s, g_mean_px, g_s)
                g_lens += params_gradient(optics, c.t, g_p)
                g_t += wp.transpose(jacobian(optics, c.t)) * g_p
                by_pose = wp.outer(g_t, x) + g_rotation
                g_r0 += by_pose
                g_t0 += g_t
                if wp.static(rolling):
                    g_r1 += c.s * by_pose
                    g_t1 += c.s * g_t
                    g_r2 += c.s * c.s * by_pose
                    g_t2 += c.s * c.s * g_t
                    g_r3 += c.s * c.s * c.s * by_pose
                    g_t3 += c.s * c.s * c.s * g_t
                g_x += wp.transpose(c.rotation) * g_t
                if optics.period > none:
                    g_lens[0] = g_lens[0] + TURN * g_turns

                g_means[i] = wp.vec3(g_x)
                r_splat = rotation(quats[i])
                scale = exp_scale(log_scales[i])
                g_local_axes = wp.mat33(g_axes)
                g_quats[i] = rotation_backward(quats[i], g_local_axes * wp.diag(scale))
                by_scale = wp.transpose(r_splat) * g_local_axes
                g_log_scales[i] = wp.vec3(scale[0] * by_scale[0, 0], scale[1] * by_scale[1, 1], scale[2] * by_scale[2, 2])
        write_pose(g_uniform, part, 0, g_r0, g_t0)
        if wp.static(rolling):
            write_pose(g_uniform, part, 1, g_r1, g_t1)
            write_pose(g_uniform, part, 2, g_r2, g_t2)
            write_pose(g_uniform, part, 3, g_r3, g_t3)
        for k in range(PARAMS):
            g_uniform[part, wp.static(POSE * (4 if rolling else 1)) + k] = float(g_lens[k])

    return LensKernels(project_lens, project_lens_backward)
