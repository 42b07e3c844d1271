"""Any lens, and shutters that move: a splat in space becomes a record, and its gradient's way back, in float64.

As project.py, with `sight.py` in place of the pinhole's closed forms.
"""

from functools import cache
from typing import NamedTuple

import warp as wp

from render.kernels.fields import exp_scale, rotation, rotation_backward, sigmoid
from render.kernels.lenses import PARALLEL, PLANAR, ROUND, LensFunctions
from render.kernels.lenses.optics import PARAMS, Optics, params
from render.kernels.motion import POWERS, motion_of, rotation_at, rotation_rate, translation_rate
from render.kernels.project import in_view
from render.kernels.ray_bound import ANYWHERE, lens_bound
from render.kernels.sight import AXIS, ROOT_HALF, column, perspective, sight_functions
from render.kernels.sigma import ROOT6, covariance_backward, least_depth_gradient, reach, reach_backward
from render.kernels.splat import colour_backward, cull, fade, gather, no_gradient, write_splat
from render.kernels.types import BASE, COUNT, DRAW, FIRST, OPTIONS, ROOT3, View

ROLLED = OPTIONS | {"max_unroll": 0}
POSE = 12
"""Numbers of one power's rotation (row major) and translation."""

TURN = wp.constant(wp.float64(6.283185307179586))
STEP = wp.constant(wp.float64(1.0e-5))


class LensKernels(NamedTuple):
    """The kernels of one lens under one kind of shutter."""

    forward: wp.Kernel
    backward: wp.Kernel


@wp.func
def write_pose(g_uniform: wp.array2d[float], part: int, power: int, rotation: wp.mat33d, translation: wp.vec3d):
    for a in range(3):
        for b in range(3):
            g_uniform[part, power * POSE + a * 3 + b] = float(rotation[a, b])
        g_uniform[part, power * POSE + 9 + a] = float(translation[a])


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


@wp.func
def scaled_axes(quat: wp.vec4, log_scale: wp.vec3):
    return rotation(quat) * wp.diag(wp.vec3d(exp_scale(log_scale)))


@cache
def lens_kernels(lens: LensFunctions, rolling: bool) -> LensKernels:
    """The kernels of a lens under a global or a moving shutter."""
    pixel, jacobian, params_gradient, depth = lens
    planar, around, parallel = depth == PLANAR, depth == ROUND, depth == PARALLEL
    readout, placed, pixel_backward, nearest, outwards, sighted, least_of, spread, turns, ellipse = sight_functions(lens, rolling)
    bound = lens_bound(lens, rolling)

    @wp.kernel(module="unique", module_options=ROLLED, enable_backward=False)
    def project_lens(
        means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
        logit_opacities: wp.array[float], sh: wp.array2d[wp.vec3],
        view: View, optics: Optics, motions: wp.array2d[wp.float64], items: wp.array2d[int], threads: int,
        records: wp.array2d[float], slopes: wp.array[wp.vec2], reach: wp.array2d[int], depth_keys: wp.array[int], counts: wp.array[int],
        first: int,
    ):  # fmt: skip
        """As `project`."""
        part = first + wp.tid()
        item = part // threads
        motion = motion_of(motions, items[item, DRAW])
        for k in range(part % threads, items[item, COUNT], threads):
            i = items[item, FIRST] + k
            j = items[item, BASE] + k
            cull(depth_keys, counts, j)
            opacity = sigmoid(logit_opacities[i])
            x = wp.vec3d(means[i])
            c = sighted(optics, motion, x, view)
            if c.seen == 1 and opacity > view.cutoff:
                axes = scaled_axes(quats[i], log_scales[i])
                ahead = bool(True)
                if wp.static(planar):
                    ahead = in_view(wp.vec3(c.t), wp.mat33(c.rotation * axes), wp.vec3(1.0), view)
                if ahead:
                    e = ellipse(optics, motion, spread(optics, motion, x, axes, c, view))
                    shows = fade(e, opacity, view)
                    if view.along_rays != 0 and shows[1] > 0.0:
                        e = bound(optics, motion, x, axes, c, shows[1], view)
                        if motion.copy != 0 and e.seen == ANYWHERE:
                            shows = wp.vec2(0.0)  # its original is seen everywhere
                    along = wp.vec3d(c.t)
                    if wp.static(parallel):
                        along = AXIS
                    sight = wp.vec3(wp.transpose(c.rotation) * along)
                    depth = float(c.depth)
                    write_splat(e, shows, depth, motion.instance, sh, i, sight, view, records, slopes, reach, depth_keys, counts, j)

    @wp.kernel(module="unique", module_options=ROLLED, enable_backward=False)
    def project_lens_backward(
        means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
        logit_opacities: wp.array[float], sh: wp.array2d[wp.vec3],
        view: View, optics: Optics, motions: wp.array2d[wp.float64], items: wp.array2d[int], threads: int,
        counts: wp.array[int], starts: wp.array[int], slots: wp.array2d[float],
        g_means: wp.array[wp.vec3], g_quats: wp.array[wp.vec4], g_log_scales: wp.array[wp.vec3],
        g_logit_opacities: wp.array[float], g_sh: wp.array2d[wp.vec3], g_uniform: wp.array2d[float],
        first: int,
    ):  # fmt: skip
        """As `project_backward`; g_uniform: POSE numbers for each power of s, then the lens's parameters."""
        part = first + wp.tid()
        item = part // threads
        motion = motion_of(motions, items[item, DRAW])
        g_r0 = wp.mat33d()  # of the pose's coefficients, and of the lens
        g_r1 = wp.mat33d()
        g_r2 = wp.mat33d()
        g_r3 = wp.mat33d()
        g_r4 = wp.mat33d()
        g_r5 = wp.mat33d()
        g_t0 = wp.vec3d()
        g_t1 = wp.vec3d()
        g_t2 = wp.vec3d()
        g_t3 = wp.vec3d()
        g_t4 = wp.vec3d()
        g_t5 = wp.vec3d()
        g_lens = params()
        one = wp.float64(1.0)
        none = wp.float64(0.0)
        for n in range(part % threads, items[item, COUNT], threads):
            i = items[item, FIRST] + n
            j = items[item, BASE] + n
            if counts[j] == 0:
                no_gradient(i, g_means, g_quats, g_log_scales, g_logit_opacities, g_sh)
            else:
                x = wp.vec3d(means[i])
                c = sighted(optics, motion, x, view)
                axes = scaled_axes(quats[i], log_scales[i])
                q = spread(optics, motion, x, axes, c, view)
                e = ellipse(optics, motion, q)
                g = gather(e, c.depth, logit_opacities[i], view, slots, starts[j], counts[j])
                g_logit_opacities[i] = g.logit
                g_mean_px = wp.vec2d(g.x, g.y)
                g_v = covariance_backward(q.v, g.xx, g.xy, g.yy, g.det0)
                g_farther = wp.float64(2.0) * g.zz * q.farther
                for k in range(3):
                    across = wp.vec2d(q.v[k, 0], q.v[k, 1])
                    if view.unscented != 0:
                        across = ROOT_HALF * wp.vec2d(q.v[2 * k, 0] - q.v[2 * k + 1, 0], q.v[2 * k, 1] - q.v[2 * k + 1, 1])
                    g_farther[k] = g_farther[k] + g.xz * across[0] + g.yz * across[1]
                    pushed = q.farther[k] * wp.vec2d(g.xz, g.yz)
                    if view.unscented == 0:
                        g_v[k, 0] = g_v[k, 0] + pushed[0]
                        g_v[k, 1] = g_v[k, 1] + pushed[1]
                    else:
                        pushed = ROOT_HALF * pushed
                        g_v[2 * k, 0] = g_v[2 * k, 0] + pushed[0]
                        g_v[2 * k, 1] = g_v[2 * k, 1] + pushed[1]
                        g_v[2 * k + 1, 0] = g_v[2 * k + 1, 0] - pushed[0]
                        g_v[2 * k + 1, 1] = g_v[2 * k + 1, 1] - pushed[1]
                shift = c.aim - c.t

                g_x = wp.vec3d()
                g_axes = wp.mat33d()
                g_rotation = wp.mat33d()  # of the centre's own pose, beyond what its point gives
                g_aim = wp.vec3d()  # explicit
                g_shift = wp.vec3d()
                g_turns = turns(optics, motion, q.centre[0] + q.v[6, 0]) * g_mean_px[0]
                out = outwards(c.t)
                g_ahead = axes * g_farther
                g_rotation += wp.outer(out, g_ahead)
                g_axes += wp.outer(wp.transpose(c.rotation) * out, g_farther)
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
                    g_least = wp.float64(0.0)
                    least = least_of(c, view)
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
                            r = reach(optics, c.aim, c.rotation * local, wp.static(depth), least)
                            tau = wp.float64(r.tau)
                            rule = int(r.rule)
                            stretch = ROOT3 / r.tau
                        point = x + tau * local
                        s = readout(optics, motion, point, shift)
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
                            power = wp.float64(s)
                            g_r1 += power * by_pose
                            g_t1 += power * g_y
                            power *= s
                            g_r2 += power * by_pose
                            g_t2 += power * g_y
                            power *= s
                            g_r3 += power * by_pose
                            g_t3 += power * g_y
                            power *= s
                            g_r4 += power * by_pose
                            g_t4 += power * g_y
                            power *= s
                            g_r5 += power * by_pose
                            g_t5 += power * g_y
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
                            g_least += back.least
                            g_rotation += wp.outer(back.offset, local)
                            g_local += wp.transpose(c.rotation) * back.offset
                        if k % 2 == 1:
                            g_local = -g_local
                        if k < 6:
                            for a in range(3):
                                g_axes[a, k // 2] = g_axes[a, k // 2] + g_local[a]
                    if wp.static(planar):
                        g_n = g_least * least_depth_gradient(perspective(c.aim), view)
                        g_aim += wp.vec3d(g_n[0], g_n[1], -wp.dot(g_n, perspective(c.aim))) / c.aim[2]

                # the centre: what hangs on t beside its pixel, then the pixel
                g_aim += g_shift
                g_t = g_aim - g_shift
                if wp.static(planar):
                    g_t = pulled_backward(c.t, c.aim, g_aim) - g_shift
                if wp.static(around):
                    g_out = c.rotation * g_ahead
                    g_t += g.depth * out + (g_out - wp.dot(out, g_out) * out) / c.depth
                else:
                    g_t += wp.vec3d(none, none, g.depth)
                along = wp.vec3d(c.t)
                if wp.static(parallel):
                    along = AXIS
                sight = wp.vec3(wp.transpose(c.rotation) * along)
                g_sight = wp.vec3d(colour_backward(sh, i, sight, g.rgb, g_sh))
                if wp.static(not parallel):
                    g_t += c.rotation * g_sight
                g_rotation += wp.outer(along, g_sight)
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
                    power = wp.float64(c.s)
                    g_r1 += power * by_pose
                    g_t1 += power * g_t
                    power *= c.s
                    g_r2 += power * by_pose
                    g_t2 += power * g_t
                    power *= c.s
                    g_r3 += power * by_pose
                    g_t3 += power * g_t
                    power *= c.s
                    g_r4 += power * by_pose
                    g_t4 += power * g_t
                    power *= c.s
                    g_r5 += power * by_pose
                    g_t5 += power * g_t
                g_x += wp.transpose(c.rotation) * g_t
                if optics.period > none:
                    g_lens[0] = g_lens[0] + TURN * g_turns

                g_means[i] = wp.vec3(g_x)
                r_splat = rotation(quats[i])
                scale = wp.vec3d(exp_scale(log_scales[i]))
                g_quats[i] = rotation_backward(quats[i], g_axes * wp.diag(scale))
                by_scale = wp.transpose(r_splat) * g_axes
                g_log_scales[i] = wp.vec3(wp.vec3d(scale[0] * by_scale[0, 0], scale[1] * by_scale[1, 1], scale[2] * by_scale[2, 2]))
        write_pose(g_uniform, part, 0, g_r0, g_t0)
        if wp.static(rolling):
            write_pose(g_uniform, part, 1, g_r1, g_t1)
            write_pose(g_uniform, part, 2, g_r2, g_t2)
            write_pose(g_uniform, part, 3, g_r3, g_t3)
            write_pose(g_uniform, part, 4, g_r4, g_t4)
            write_pose(g_uniform, part, 5, g_r5, g_t5)
        for k in range(PARAMS):
            g_uniform[part, wp.static(POSE * (POWERS if rolling else 1)) + k] = float(g_lens[k])

    return LensKernels(project_lens, project_lens_backward)
