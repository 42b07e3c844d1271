"""Pinhole cameras with a global shutter: a splat in space becomes a record, and its gradient's way back.

Other lenses and moving shutters have kernels of their own (project_lens.py). A splat is not drawn when its ellipsoid of 3.33 sigma
lies wholly beyond one side of the view.
"""

import warp as wp

from render.kernels.fields import exp_scale, rotation, rotation_backward, sigmoid
from render.kernels.moments import (
    Axis,
    Footprint,
    axis_backward,
    cross2,
    cross_gradient,
    footprint,
    gradient_of_quadratic,
    quadratic,
    vec_axis,
)
from render.kernels.ray_bound import pinhole_bound
from render.kernels.sigma import least_depth_gradient
from render.kernels.splat import Ellipse, colour_backward, cull, fade, gather, no_gradient, write_splat
from render.kernels.types import BASE, COUNT, DRAW, FARTHEST, FIRST, HALF, OPTIONS, REACH, TWO, UNIFORM_GRADIENTS, View, pose_of

wp.set_module_options(OPTIONS)

vec_uniform = wp.types.vector(length=UNIFORM_GRADIENTS, dtype=wp.float64)


@wp.func
def beyond(t: wp.vec3, axes: wp.mat33, scale: wp.vec3, side: wp.vec3):
    """Whether the splat's ellipsoid lies wholly on the positive side of the plane through the eye with normal `side`."""
    along = wp.cw_mul(wp.transpose(axes) * side, scale)
    distance = wp.dot(side, t)
    return distance > 0.0 and distance * distance > REACH * REACH * wp.dot(along, along)


@wp.func
def in_view(t: wp.vec3, axes: wp.mat33, scale: wp.vec3, view: View):
    outside = beyond(t, axes, scale, wp.vec3(1.0, 0.0, -view.right)) or beyond(t, axes, scale, wp.vec3(-1.0, 0.0, view.left))
    return not (outside or beyond(t, axes, scale, wp.vec3(0.0, 1.0, -view.bottom)) or beyond(t, axes, scale, wp.vec3(0.0, -1.0, view.top)))


@wp.func
def ellipse(t: wp.vec3d, f: Footprint, view: View):
    e = Ellipse()
    e.x = view.lens[0] * (t[0] / t[2]) + view.lens[2] + f.mu[0]
    e.y = view.lens[1] * (t[1] / t[2]) + view.lens[3] + f.mu[1]
    e.xx = f.xx
    e.xy = f.xy
    e.yy = f.yy
    e.det0 = f.det0
    e.xz = f.xz
    e.yz = f.yz
    e.zz = f.zz
    return e


@wp.kernel
def project(
    means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
    logit_opacities: wp.array[float], sh: wp.array2d[wp.vec3],
    view: View, poses: wp.array2d[wp.float64], items: wp.array2d[int], threads: int,
    records: wp.array2d[float], slopes: wp.array[wp.vec2], reach: wp.array2d[int], depth_keys: wp.array[int], counts: wp.array[int],
    first: int,
):  # fmt: skip
    """Records, slopes where they are wanted, depth keys and tiles at most of a group's splats; `threads` threads share an item."""
    part = first + wp.tid()
    item = part // threads
    pose = pose_of(poses, items[item, DRAW])
    for k in range(part % threads, items[item, COUNT], threads):
        i = items[item, FIRST] + k
        j = items[item, BASE] + k
        cull(depth_keys, counts, j)
        exact = pose.rotation * wp.vec3d(means[i]) + pose.translation
        t = wp.vec3(exact)
        opacity = sigmoid(logit_opacities[i])
        if t[2] > view.near and wp.dot(t, t) < FARTHEST * FARTHEST and opacity > view.cutoff:
            axes = pose.rotation * rotation(quats[i])
            scale = exp_scale(log_scales[i])
            if in_view(t, wp.mat33(axes), scale, view):
                e = ellipse(exact, footprint(exact, axes, wp.vec3d(scale), view), view)
                shows = fade(e, opacity, view)
                if view.along_rays != 0 and shows[1] > 0.0:
                    e = pinhole_bound(exact, axes * wp.diag(wp.vec3d(scale)), shows[1], view)
                sight = means[i] - pose.eye
                write_splat(e, shows, t[2], pose.instance, sh, i, sight, view, records, slopes, reach, depth_keys, counts, j)


@wp.func
def by_offset(g: vec_axis, a: Axis):
    """d loss / d log scale of an axis: its offset grows with the scale."""
    return g[0] * a.offset[0] + g[1] * a.offset[1] + g[2] * a.offset[2]


@wp.kernel
def project_backward(
    means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
    logit_opacities: wp.array[float], sh: wp.array2d[wp.vec3],
    view: View, poses: wp.array2d[wp.float64], items: wp.array2d[int], threads: int,
    counts: wp.array[int], starts: wp.array[int], slots: wp.array2d[float],
    g_means: wp.array[wp.vec3], g_quats: wp.array[wp.vec4], g_log_scales: wp.array[wp.vec3],
    g_logit_opacities: wp.array[float], g_sh: wp.array2d[wp.vec3], g_uniform: wp.array2d[float],
    first: int,
):  # fmt: skip
    """Sum each splat's slots in fixed order and carry them back; a thread sums its splats' pose gradient."""
    part = first + wp.tid()
    item = part // threads
    pose = pose_of(poses, items[item, DRAW])
    uniform = vec_uniform()
    for k in range(part % threads, items[item, COUNT], threads):
        i = items[item, FIRST] + k
        j = items[item, BASE] + k
        if counts[j] == 0:
            no_gradient(i, g_means, g_quats, g_log_scales, g_logit_opacities, g_sh)
        else:
            t = pose.rotation * wp.vec3d(means[i]) + pose.translation
            z = t[2]
            r_splat = rotation(quats[i])
            scale = wp.vec3d(exp_scale(log_scales[i]))
            f = footprint(t, pose.rotation * r_splat, scale, view)
            g = gather(ellipse(t, f, view), z, logit_opacities[i], view, slots, starts[j], counts[j])
            g_logit_opacities[i] = g.logit

            uv = cross2(f.u.e, f.v.e)
            uw = cross2(f.u.e, f.w.e)
            vw = cross2(f.v.e, f.w.e)
            um = cross2(f.u.e, f.mu)
            vm = cross2(f.v.e, f.mu)
            wm = cross2(f.w.e, f.mu)
            g_wu = g.det0 * (f.v.w * uv * uv + f.w.w * uw * uw + um * um) + quadratic(g.xx, g.xy, g.yy, f.u.e)
            g_wv = g.det0 * (f.u.w * uv * uv + f.w.w * vw * vw + vm * vm) + quadratic(g.xx, g.xy, g.yy, f.v.e)
            g_ww = g.det0 * (f.u.w * uw * uw + f.v.w * vw * vw + wm * wm) + quadratic(g.xx, g.xy, g.yy, f.w.e)
            g_uv = TWO * g.det0 * f.u.w * f.v.w * uv
            g_uw = TWO * g.det0 * f.u.w * f.w.w * uw
            g_vw = TWO * g.det0 * f.v.w * f.w.w * vw
            g_um = TWO * g.det0 * f.u.w * um
            g_vm = TWO * g.det0 * f.v.w * vm
            g_wm = TWO * g.det0 * f.w.w * wm
            g_xy_px = wp.vec2d(g.x, g.y)
            g_mu = g_xy_px + gradient_of_quadratic(g.xx, g.xy, g.yy, f.mu)
            g_mu -= cross_gradient(f.u.e, g_um) + cross_gradient(f.v.e, g_vm) + cross_gradient(f.w.e, g_wm)
            g_eu = f.u.w * gradient_of_quadratic(g.xx, g.xy, g.yy, f.u.e) + f.u.b * g_mu
            g_ev = f.v.w * gradient_of_quadratic(g.xx, g.xy, g.yy, f.v.e) + f.v.b * g_mu
            g_ew = f.w.w * gradient_of_quadratic(g.xx, g.xy, g.yy, f.w.e) + f.w.b * g_mu
            g_eu += cross_gradient(f.v.e, g_uv) + cross_gradient(f.w.e, g_uw) + cross_gradient(f.mu, g_um)
            g_ev += cross_gradient(f.w.e, g_vw) - cross_gradient(f.u.e, g_uv) + cross_gradient(f.mu, g_vm)
            g_ew += cross_gradient(f.mu, g_wm) - cross_gradient(f.u.e, g_uw) - cross_gradient(f.v.e, g_vw)
            rise = wp.vec2d()
            if f.least > HALF:
                rise = least_depth_gradient(f.n, view)
            by_depth = wp.vec3d(g.xz, g.yz, g.zz)
            a_u = axis_backward(f.u, g_eu, g_wu, wp.dot(g_mu, f.u.e), by_depth, f.n, z, f.least, rise, view)
            a_v = axis_backward(f.v, g_ev, g_wv, wp.dot(g_mu, f.v.e), by_depth, f.n, z, f.least, rise, view)
            a_w = axis_backward(f.w, g_ew, g_ww, wp.dot(g_mu, f.w.e), by_depth, f.n, z, f.least, rise, view)

            # the centre: pixel = f n + c + mu, with n not clamped; the Jacobian's n is clamped under EWA
            nx = f.along[0]
            ny = f.along[1]
            g_nx = view.lens[0] * g_xy_px[0]
            g_ny = view.lens[1] * g_xy_px[1]
            if nx == f.n[0]:
                g_nx += a_u[3] + a_v[3] + a_w[3]
            if ny == f.n[1]:
                g_ny += a_u[4] + a_v[4] + a_w[4]
            g_t = wp.vec3d(g_nx / z, g_ny / z, a_u[5] + a_v[5] + a_w[5] + g.depth - (g_nx * nx + g_ny * ny) / z)

            g_axes = wp.mat33d(
                scale[0] * a_u[0], scale[1] * a_v[0], scale[2] * a_w[0],
                scale[0] * a_u[1], scale[1] * a_v[1], scale[2] * a_w[1],
                scale[0] * a_u[2], scale[1] * a_v[2], scale[2] * a_w[2],
            )  # fmt: skip
            g_log_scales[i] = wp.vec3(wp.vec3d(by_offset(a_u, f.u), by_offset(a_v, f.v), by_offset(a_w, f.w)))
            g_quats[i] = rotation_backward(quats[i], wp.transpose(pose.rotation) * g_axes)

            sight = means[i] - pose.eye
            g_sight = wp.vec3d(colour_backward(sh, i, sight, g.rgb, g_sh))
            g_means[i] = wp.vec3(wp.transpose(pose.rotation) * g_t + g_sight)

            # eye = -R' t, so its gradient (-g_sight) reaches rotation and translation as well
            g_rotation = wp.outer(g_t, wp.vec3d(means[i])) + g_axes * wp.transpose(r_splat) + wp.outer(pose.translation, g_sight)
            g_translation = g_t + pose.rotation * g_sight
            for c in range(9):
                uniform[c] = uniform[c] + g_rotation[c // 3, c % 3]
            for c in range(3):
                uniform[9 + c] = uniform[9 + c] + g_translation[c]
            uniform[12] = uniform[12] + a_u[6] + a_v[6] + a_w[6] + g_xy_px[0] * nx
            uniform[13] = uniform[13] + a_u[7] + a_v[7] + a_w[7] + g_xy_px[1] * ny
            uniform[14] = uniform[14] + g_xy_px[0]
            uniform[15] = uniform[15] + g_xy_px[1]
    for c in range(UNIFORM_GRADIENTS):
        g_uniform[part, c] = float(uniform[c])
