"""A splat becomes a 2D Gaussian on the image: EWA (Zwicker et al. 2001) or the unscented transform (Wu et al. 2025, 3DGUT).

Both in one form. Axis k of the splat, as an offset o from its centre t in the camera, moves the pixel along
e = f (o_xy - n o_z), n = t_xy / t_z. EWA moves it by e / z. The unscented transform (alpha = 1, beta = 2, kappa = 0, so sigma
points at +-sqrt(3)) moves it by +-r e with r = sqrt(3) / (z +- sqrt(3) o_z): exact for a pinhole and free of cancellation, since
nothing is measured from the image origin. Then

    covariance = sum_k w_k e_k e_k' + mu mu',   mu = sum_k b_k e_k,   w = (r+^2 + r-^2) / 6,  b = (r+ - r-) / 6

and its determinant is a sum of squares (Cauchy-Binet), so that needles keep all their digits. Near the camera plane the moments of
a perspective Gaussian diverge and a splat beside the car would flood the image, so: a sigma point nearer than half the centre's
depth, or behind the camera, is projected as if it lay at that half; n is taken no further out than 1.3 times half the view; and
a splat is not drawn when its ellipsoid of 3.33 sigma lies wholly beyond one side of the view. All continuous where it can be seen.
"""

import warp as wp

from render.kernels.bin import ROOM, tile_span
from render.kernels.harmonics import harmonics, harmonics_backward
from render.kernels.types import (
    BLUE,
    G_BLUE,
    G_GREEN,
    G_H,
    G_K,
    G_M,
    G_OPACITY,
    G_RED,
    G_X,
    G_Y,
    G_Z,
    GRADIENTS,
    GREEN,
    INSTANCE,
    INV_C,
    INV_K,
    OPACITY,
    OPTIONS,
    RED,
    S_MAX,
    SLACK,
    UNIFORM_GRADIENTS,
    Y_AT_EXT,
    Y_EXT,
    H,
    K,
    M,
    Pose,
    View,
    X,
    Y,
    Z,
)

wp.set_module_options(OPTIONS)

ROOT3 = wp.constant(1.7320508075688772)
NEAREST = wp.constant(0.5)
REACH = wp.constant(3.33)  # sigma at which the most opaque splat has faded to 1/255
CULLED = wp.constant(2147483647)
TINY = wp.constant(1.0e-30)
FARTHEST = wp.constant(1.0e12)  # metres from the camera beyond which a splat is not drawn: squares of squares must stay floats
vec_gradients = wp.types.vector(length=GRADIENTS, dtype=wp.float32)
vec_axis = wp.types.vector(length=8, dtype=wp.float32)
vec_uniform = wp.types.vector(length=UNIFORM_GRADIENTS, dtype=wp.float32)


@wp.struct
class Axis:
    """One principal axis of a splat in the camera and on the image."""

    offset: wp.vec3
    e: wp.vec2
    w: float
    b: float
    near_z: float  # of the sigma point at -sqrt(3), after the clamp
    far_z: float


@wp.struct
class Footprint:
    """The 2D Gaussian before dilation; det0 is the determinant of its covariance."""

    n: wp.vec2  # where on the image plane z = 1 the Jacobian is taken
    u: Axis
    v: Axis
    w: Axis
    mu: wp.vec2
    xx: float
    xy: float
    yy: float
    det0: float


@wp.func
def cross2(a: wp.vec2, b: wp.vec2):
    return a[0] * b[1] - a[1] * b[0]


@wp.func
def rotation(q: wp.vec4):
    """Rotation of a quaternion wxyz of any positive length."""
    n = q / wp.max(wp.length(q), TINY)
    w = n[0]
    x = n[1]
    y = n[2]
    z = n[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def rotation_backward(q: wp.vec4, g: wp.mat33):
    """d loss / d quaternion, normalisation included."""
    length = wp.max(wp.length(q), TINY)
    n = q / length
    w = n[0]
    x = n[1]
    y = n[2]
    z = n[3]
    g_n = 2.0 * wp.vec4(
        x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]),
        w * (g[2, 1] - g[1, 2]) + y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) - 2.0 * x * (g[1, 1] + g[2, 2]),
        w * (g[0, 2] - g[2, 0]) + x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) - 2.0 * y * (g[0, 0] + g[2, 2]),
        w * (g[1, 0] - g[0, 1]) + x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) - 2.0 * z * (g[0, 0] + g[1, 1]),
    )
    return (g_n - n * wp.dot(n, g_n)) / length


@wp.func
def project_axis(offset: wp.vec3, n: wp.vec2, z: float, view: View):
    a = Axis()
    a.offset = offset
    a.e = wp.vec2(view.fx * (offset[0] - n[0] * offset[2]), view.fy * (offset[1] - n[1] * offset[2]))
    if view.unscented == 0:
        a.w = 1.0 / (z * z)
        a.b = 0.0
    else:
        a.far_z = wp.max(z + ROOT3 * offset[2], NEAREST * z)
        a.near_z = wp.max(z - ROOT3 * offset[2], NEAREST * z)
        r_far = ROOT3 / a.far_z
        r_near = ROOT3 / a.near_z
        a.w = (r_far * r_far + r_near * r_near) / 6.0
        a.b = ROOT3 * (a.near_z - a.far_z) / (6.0 * a.near_z * a.far_z)
    return a


@wp.func
def footprint(t: wp.vec3, axes: wp.mat33, scale: wp.vec3, view: View):
    """axes: the splat's principal directions in the camera, as columns; scale in metres."""
    f = Footprint()
    z = t[2]
    f.n = wp.vec2(wp.clamp(t[0] / z, view.clamp_left, view.clamp_right), wp.clamp(t[1] / z, view.clamp_top, view.clamp_bottom))
    f.u = project_axis(scale[0] * wp.vec3(axes[0, 0], axes[1, 0], axes[2, 0]), f.n, z, view)
    f.v = project_axis(scale[1] * wp.vec3(axes[0, 1], axes[1, 1], axes[2, 1]), f.n, z, view)
    f.w = project_axis(scale[2] * wp.vec3(axes[0, 2], axes[1, 2], axes[2, 2]), f.n, z, view)
    f.mu = f.u.b * f.u.e + f.v.b * f.v.e + f.w.b * f.w.e
    f.xx = f.u.w * f.u.e[0] * f.u.e[0] + f.v.w * f.v.e[0] * f.v.e[0] + f.w.w * f.w.e[0] * f.w.e[0] + f.mu[0] * f.mu[0]
    f.xy = f.u.w * f.u.e[0] * f.u.e[1] + f.v.w * f.v.e[0] * f.v.e[1] + f.w.w * f.w.e[0] * f.w.e[1] + f.mu[0] * f.mu[1]
    f.yy = f.u.w * f.u.e[1] * f.u.e[1] + f.v.w * f.v.e[1] * f.v.e[1] + f.w.w * f.w.e[1] * f.w.e[1] + f.mu[1] * f.mu[1]
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
def beyond(t: wp.vec3, axes: wp.mat33, scale: wp.vec3, side: wp.vec3):
    """Whether the splat's ellipsoid lies wholly on the positive side of the plane through the eye with normal `side`."""
    along = wp.cw_mul(wp.transpose(axes) * side, scale)
    return wp.dot(side, t) > REACH * wp.length(along)


@wp.func
def in_view(t: wp.vec3, axes: wp.mat33, scale: wp.vec3, view: View):
    outside = beyond(t, axes, scale, wp.vec3(1.0, 0.0, -view.right)) or beyond(t, axes, scale, wp.vec3(-1.0, 0.0, view.left))
    return not (outside or beyond(t, axes, scale, wp.vec3(0.0, 1.0, -view.bottom)) or beyond(t, axes, scale, wp.vec3(0.0, -1.0, view.top)))


@wp.func
def exp_scale(log_scale: wp.vec3):
    return wp.vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))


@wp.func
def sigmoid(x: float):
    return 1.0 / (1.0 + wp.exp(-x))


@wp.kernel
def project(
    means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
    logit_opacities: wp.array[float], sh: wp.array2d[wp.vec3],
    view: View, pose: Pose, base: int,
    records: wp.array2d[float], depth_keys: wp.array[int], counts: wp.array[int],
    first: int,
):  # fmt: skip
    """Records, depth keys (the bits of a positive float sort as an int) and tiles at most of one instance, from record `base`."""
    i = first + wp.tid()
    j = base + i
    counts[j] = 0
    depth_keys[j] = CULLED
    t = pose.rotation * means[i] + pose.translation
    opacity = sigmoid(logit_opacities[i])
    if t[2] > view.near and wp.dot(t, t) < FARTHEST * FARTHEST and opacity > view.least_opacity:
        axes = pose.rotation * rotation(quats[i])
        scale = exp_scale(log_scales[i])
        if in_view(t, axes, scale, view):
            f = footprint(t, axes, scale, view)
            xx = f.xx + view.dilation
            yy = f.yy + view.dilation
            det = f.det0 + view.dilation * (f.xx + f.yy + view.dilation)
            if view.antialias != 0:
                opacity = opacity * wp.sqrt(f.det0 / wp.max(det, TINY))
            s_max = wp.log(wp.max(opacity, view.faint)) + view.log_cutoff
            if opacity <= view.least_opacity:
                s_max = 0.0
            # written so that a NaN anywhere culls the splat instead of spreading
            if s_max > 0.0 and det > TINY and yy > TINY and xx < 1.0e16 and yy < 1.0e16:
                k2 = 0.5 * yy / det
                k = wp.sqrt(k2)
                m = f.xy / yy
                h = 0.5 / yy
                c = k2 * m * m + h
                records[j, X] = view.fx * t[0] / t[2] + view.cx + f.mu[0]
                records[j, Y] = view.fy * t[1] / t[2] + view.cy + f.mu[1]
                records[j, K] = k
                records[j, M] = m
                records[j, H] = h
                records[j, OPACITY] = opacity
                records[j, S_MAX] = s_max
                records[j, Z] = t[2]
                records[j, INSTANCE] = pose.instance
                records[j, Y_EXT] = wp.sqrt(s_max / h)
                records[j, INV_K] = 1.0 / k
                records[j, INV_C] = 1.0 / c
                root = wp.sqrt(s_max / (c * h))
                records[j, Y_AT_EXT] = k * m * root
                rows = tile_span(records[j, Y], ROOM * records[j, Y_EXT] + SLACK, view.tiles_y)
                columns = tile_span(records[j, X], ROOM * c * root / k + SLACK, view.tiles_x)
                total = wp.max(rows[1] - rows[0] + 1, 0) * wp.max(columns[1] - columns[0] + 1, 0)
                colour = wp.vec3(0.0)
                if total > 0:
                    colour = harmonics(sh, i, view.sh_count, wp.normalize(means[i] - pose.eye))
                if total > 0 and wp.isfinite(colour):
                    counts[j] = total
                    depth_keys[j] = wp.cast(t[2], int)
                    records[j, RED] = wp.max(colour[0], 0.0)
                    records[j, GREEN] = wp.max(colour[1], 0.0)
                    records[j, BLUE] = wp.max(colour[2], 0.0)


@wp.func
def cross_gradient(b: wp.vec2, g: float):
    """g times d cross2(a, b) / d a; by b it is minus the same with a in place of b."""
    return wp.vec2(g * b[1], -g * b[0])


@wp.func
def quadratic(xx: float, xy: float, yy: float, v: wp.vec2):
    return xx * v[0] * v[0] + xy * v[0] * v[1] + yy * v[1] * v[1]


@wp.func
def gradient_of_quadratic(xx: float, xy: float, yy: float, v: wp.vec2):
    return wp.vec2(2.0 * xx * v[0] + xy * v[1], xy * v[0] + 2.0 * yy * v[1])


@wp.func
def axis_backward(a: Axis, g_e: wp.vec2, g_w: float, g_b: float, n: wp.vec2, z: float, view: View):
    """d loss / d (offset, n, z, f) packed as a vector of 8."""
    g_z = float(0.0)
    g_oz = float(0.0)
    if view.unscented == 0:
        g_z = -2.0 * a.w / z * g_w
    else:
        r_far = ROOT3 / a.far_z
        r_near = ROOT3 / a.near_z
        g_far = -(g_w * r_far / 3.0 + g_b / 6.0) * r_far / a.far_z
        g_near = -(g_w * r_near / 3.0 - g_b / 6.0) * r_near / a.near_z
        if z + ROOT3 * a.offset[2] >= NEAREST * z:
            g_z += g_far
            g_oz += ROOT3 * g_far
        else:
            g_z += NEAREST * g_far
        if z - ROOT3 * a.offset[2] >= NEAREST * z:
            g_z += g_near
            g_oz -= ROOT3 * g_near
        else:
            g_z += NEAREST * g_near
    gx = view.fx * g_e[0]
    gy = view.fy * g_e[1]
    g_oz -= gx * n[0] + gy * n[1]
    return vec_axis(
        gx, gy, g_oz, -gx * a.offset[2], -gy * a.offset[2], g_z,
        g_e[0] * (a.offset[0] - n[0] * a.offset[2]), g_e[1] * (a.offset[1] - n[1] * a.offset[2]),
    )  # fmt: skip


@wp.kernel
def project_backward(
    means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
    logit_opacities: wp.array[float], sh: wp.array2d[wp.vec3],
    view: View, pose: Pose, base: int, n_splats: int, chunk: int,
    counts: wp.array[int], starts: wp.array[int], slots: wp.array2d[float],
    g_means: wp.array[wp.vec3], g_quats: wp.array[wp.vec4], g_log_scales: wp.array[wp.vec3],
    g_logit_opacities: wp.array[float], g_sh: wp.array2d[wp.vec3], g_uniform: wp.array2d[float],
    first: int,
):  # fmt: skip
    """Sum each splat's slots in fixed order and carry them back; a thread takes `chunk` splats and sums their pose gradient."""
    part = first + wp.tid()
    uniform = vec_uniform()
    for i in range(part * chunk, wp.min(part * chunk + chunk, n_splats)):
        j = base + i
        g_means[i] = wp.vec3(0.0)
        g_quats[i] = wp.vec4(0.0)
        g_log_scales[i] = wp.vec3(0.0)
        g_logit_opacities[i] = 0.0
        if counts[j] == 0:
            for b in range(view.sh_count):
                g_sh[i, b] = wp.vec3(0.0)
        else:
            g = vec_gradients()
            for slot in range(starts[j], starts[j] + counts[j]):
                for c in range(GRADIENTS):
                    g[c] = g[c] + slots[slot, c]

            t = pose.rotation * means[i] + pose.translation
            z = t[2]
            r_splat = rotation(quats[i])
            scale = exp_scale(log_scales[i])
            f = footprint(t, pose.rotation * r_splat, scale, view)
            yy = f.yy + view.dilation
            det = f.det0 + view.dilation * (f.xx + f.yy + view.dilation)
            o = sigmoid(logit_opacities[i])
            k = wp.sqrt(0.5 * yy / det)
            m = f.xy / yy
            h = 0.5 / yy

            g_det = -0.5 * g[G_K] * k / det  # det = det0 + dilation (xx0 + yy0 + dilation)
            g_trace = g_det
            g_det0 = g_det
            g_yy = (0.5 * g[G_K] * k - g[G_M] * m - g[G_H] * h) / yy
            g_xy = g[G_M] / yy
            g_o = g[G_OPACITY]
            if view.antialias != 0:
                # opacity sqrt(det0 / det): its two derivatives by det0 nearly cancel for large splats, so they are taken together
                ratio = wp.sqrt(f.det0 / det)
                g_ratio = 0.5 * g_o * o * ratio / det
                g_trace -= g_ratio
                g_det0 += g_ratio * view.dilation * (f.xx + f.yy + view.dilation) / wp.max(f.det0, TINY)
                g_o = g_o * ratio
            g_logit_opacities[i] = g_o * o * (1.0 - o)
            g_xx = g_trace * view.dilation
            g_yy += g_trace * view.dilation

            uv = cross2(f.u.e, f.v.e)
            uw = cross2(f.u.e, f.w.e)
            vw = cross2(f.v.e, f.w.e)
            um = cross2(f.u.e, f.mu)
            vm = cross2(f.v.e, f.mu)
            wm = cross2(f.w.e, f.mu)
            g_wu = g_det0 * (f.v.w * uv * uv + f.w.w * uw * uw + um * um) + quadratic(g_xx, g_xy, g_yy, f.u.e)
            g_wv = g_det0 * (f.u.w * uv * uv + f.w.w * vw * vw + vm * vm) + quadratic(g_xx, g_xy, g_yy, f.v.e)
            g_ww = g_det0 * (f.u.w * uw * uw + f.v.w * vw * vw + wm * wm) + quadratic(g_xx, g_xy, g_yy, f.w.e)
            g_uv = 2.0 * g_det0 * f.u.w * f.v.w * uv
            g_uw = 2.0 * g_det0 * f.u.w * f.w.w * uw
            g_vw = 2.0 * g_det0 * f.v.w * f.w.w * vw
            g_um = 2.0 * g_det0 * f.u.w * um
            g_vm = 2.0 * g_det0 * f.v.w * vm
            g_wm = 2.0 * g_det0 * f.w.w * wm
            g_xy_px = wp.vec2(g[G_X], g[G_Y])
            g_mu = g_xy_px + gradient_of_quadratic(g_xx, g_xy, g_yy, f.mu)
            g_mu -= cross_gradient(f.u.e, g_um) + cross_gradient(f.v.e, g_vm) + cross_gradient(f.w.e, g_wm)
            g_eu = f.u.w * gradient_of_quadratic(g_xx, g_xy, g_yy, f.u.e) + f.u.b * g_mu
            g_ev = f.v.w * gradient_of_quadratic(g_xx, g_xy, g_yy, f.v.e) + f.v.b * g_mu
            g_ew = f.w.w * gradient_of_quadratic(g_xx, g_xy, g_yy, f.w.e) + f.w.b * g_mu
            g_eu += cross_gradient(f.v.e, g_uv) + cross_gradient(f.w.e, g_uw) + cross_gradient(f.mu, g_um)
            g_ev += cross_gradient(f.w.e, g_vw) - cross_gradient(f.u.e, g_uv) + cross_gradient(f.mu, g_vm)
            g_ew += cross_gradient(f.mu, g_wm) - cross_gradient(f.u.e, g_uw) - cross_gradient(f.v.e, g_vw)
            a_u = axis_backward(f.u, g_eu, g_wu, wp.dot(g_mu, f.u.e), f.n, z, view)
            a_v = axis_backward(f.v, g_ev, g_wv, wp.dot(g_mu, f.v.e), f.n, z, view)
            a_w = axis_backward(f.w, g_ew, g_ww, wp.dot(g_mu, f.w.e), f.n, z, view)

            # the centre: pixel = f n + c + mu, with n not clamped; the Jacobian's n is clamped under EWA
            nx = t[0] / z
            ny = t[1] / z
            g_nx = view.fx * g_xy_px[0]
            g_ny = view.fy * g_xy_px[1]
            if nx == f.n[0]:
                g_nx += a_u[3] + a_v[3] + a_w[3]
            if ny == f.n[1]:
                g_ny += a_u[4] + a_v[4] + a_w[4]
            g_t = wp.vec3(g_nx / z, g_ny / z, a_u[5] + a_v[5] + a_w[5] + g[G_Z] - (g_nx * nx + g_ny * ny) / z)

            g_axes = wp.mat33(
                scale[0] * a_u[0], scale[1] * a_v[0], scale[2] * a_w[0],
                scale[0] * a_u[1], scale[1] * a_v[1], scale[2] * a_w[1],
                scale[0] * a_u[2], scale[1] * a_v[2], scale[2] * a_w[2],
            )  # fmt: skip
            g_log_scales[i] = wp.vec3(
                a_u[0] * f.u.offset[0] + a_u[1] * f.u.offset[1] + a_u[2] * f.u.offset[2],
                a_v[0] * f.v.offset[0] + a_v[1] * f.v.offset[1] + a_v[2] * f.v.offset[2],
                a_w[0] * f.w.offset[0] + a_w[1] * f.w.offset[1] + a_w[2] * f.w.offset[2],
            )
            g_quats[i] = rotation_backward(quats[i], wp.transpose(pose.rotation) * g_axes)

            sight = means[i] - pose.eye
            distance = wp.max(wp.length(sight), TINY)
            direction = sight / distance
            colour = harmonics(sh, i, view.sh_count, direction)
            g_rgb = wp.vec3(g[G_RED], g[G_GREEN], g[G_BLUE])
            for c in range(3):
                if colour[c] <= 0.0:
                    g_rgb[c] = 0.0
            g_direction = harmonics_backward(sh, i, view.sh_count, direction, g_rgb, g_sh)
            g_sight = (g_direction - direction * wp.dot(direction, g_direction)) / distance
            g_means[i] = wp.transpose(pose.rotation) * g_t + g_sight

            # eye = -R' t, so its gradient (-g_sight) reaches rotation and translation as well
            g_rotation = wp.outer(g_t, means[i]) + g_axes * wp.transpose(r_splat) + wp.outer(pose.translation, g_sight)
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
        g_uniform[part, c] = uniform[c]
