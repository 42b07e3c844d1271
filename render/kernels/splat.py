"""What every projection ends in: the record of a 2D Gaussian, with its colour, and the way back from the gradient slots.

Nothing from here on knows of lenses or shutters.
"""

import warp as wp

from render.kernels.bin import ROOM, note_reach, span_of, within
from render.kernels.fields import sigmoid
from render.kernels.harmonics import harmonics, harmonics_backward
from render.kernels.types import (
    BLUE,
    CULLED,
    G_ALONG,
    G_BLUE,
    G_DOWN,
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
    HALF,
    INSTANCE,
    LEAST,
    ONE,
    OPACITY,
    REACH,
    RED,
    S_MAX,
    SLACK,
    TINY,
    X_REST,
    Y_AT_EXT,
    Y_EXT,
    Y_REST,
    H,
    K,
    M,
    View,
    X,
    Y,
    Z,
)

LARGEST = wp.constant(wp.float64(1.0e16))  # px^2, of a variance: beyond it floats lose the rest
STEEPEST = wp.constant(wp.float64(2.0 * REACH))

vec_gradients = wp.types.vector(length=GRADIENTS, dtype=wp.float64)


@wp.struct
class Ellipse:
    """A splat on the image before dilation: mean, covariance, and its determinant by a way that does not cancel."""

    x: wp.float64
    y: wp.float64
    xx: wp.float64
    xy: wp.float64
    yy: wp.float64
    det0: wp.float64
    xz: wp.float64  # with depth, whose variance is zz
    yz: wp.float64
    zz: wp.float64
    seen: float  # along rays, how far from x, in pixels


@wp.struct
class EllipseGradient:
    """d loss / d Ellipse and what else a record carries."""

    x: wp.float64
    y: wp.float64
    xx: wp.float64
    xy: wp.float64
    yy: wp.float64
    det0: wp.float64
    xz: wp.float64
    yz: wp.float64
    zz: wp.float64
    depth: wp.float64
    logit: float
    rgb: wp.vec3


@wp.func
def dilated(e: Ellipse, view: View):
    """Both variances and the determinant, dilated."""
    dilation = wp.float64(view.dilation)
    return wp.vec3d(e.xx + dilation, e.yy + dilation, e.det0 + dilation * (e.xx + e.yy + dilation))


@wp.func
def unsmoothed(e: Ellipse, view: View):
    """The determinant, dilated by what is no smoothing."""
    rest = wp.float64(view.dilation) - wp.float64(view.smoothing)
    return e.det0 + rest * (e.xx + e.yy + rest)


@wp.func
def fade(e: Ellipse, opacity: float, view: View):
    """Opacity, compensated for the smoothing, and the exponent up to which the splat shows; 0 where it does not."""
    if view.smoothing > 0.0:
        opacity = opacity * wp.sqrt(float(unsmoothed(e, view) / wp.max(dilated(e, view)[2], LEAST)))
    s_max = wp.log(wp.max(opacity, view.cutoff)) + view.log_cutoff
    if opacity <= view.cutoff or not (e.xx < LARGEST and e.yy < LARGEST):
        s_max = 0.0
    return wp.vec2(opacity, s_max)


@wp.func
def regressed(e: Ellipse, view: View):
    """What depth grows by, a pixel: its regression on where the splat, dilated, is seen."""
    wide = dilated(e, view)
    return wp.vec2d((wide[1] * e.xz - e.xy * e.yz) / wide[2], (wide[0] * e.yz - e.xy * e.xz) / wide[2])


@wp.func
def calmed(e: Ellipse, depth: wp.float64):
    """Of that what is kept, so that a splat is nowhere nearer than half its depth: to first order it would reach behind the eye."""
    room = depth / STEEPEST
    if e.zz > room * room:
        return room / wp.sqrt(e.zz)
    return ONE


@wp.func
def slopes_of(e: Ellipse, depth: wp.float64, view: View):
    """What a splat's depth grows by, a pixel to the right and down."""
    return wp.vec2(calmed(e, depth) * regressed(e, view))


@wp.func
def write_splat(
    e: Ellipse, shows: wp.vec2, depth: float, instance: float, sh: wp.array2d[wp.vec3], i: int, sight: wp.vec3, view: View,
    records: wp.array2d[float], slopes: wp.array[wp.vec2], reach: wp.array2d[int], depth_keys: wp.array[int], counts: wp.array[int], j: int,
):  # fmt: skip
    """Record j, its slopes where they are wanted, its reach, its depth key (the bits of a positive float sort as an int) and tiles at
    most; left culled where nothing shows.

    shows: as of `fade`. sight: the way it is seen, from the eye to the splat, in its local frame, of any length.
    """
    wide = dilated(e, view)
    xx = wide[0]
    yy = wide[1]
    det = wide[2]
    s_max = shows[1]
    # written so that a NaN anywhere culls the splat instead of spreading
    if s_max > 0.0 and det > LEAST and xx > LEAST and yy > LEAST and xx < LARGEST and yy < LARGEST:
        x_ext = wp.sqrt(2.0 * s_max * float(xx))
        y_ext = wp.sqrt(2.0 * s_max * float(yy))
        x = float(e.x)
        y = float(e.y)
        records[j, X] = x
        records[j, Y] = y
        records[j, X_REST] = float(e.x - wp.float64(x))
        records[j, Y_REST] = float(e.y - wp.float64(y))
        if view.along_rays != 0:
            records[j, X_REST] = e.seen
        records[j, K] = float(wp.sqrt(HALF * yy / det))
        records[j, M] = float(e.xy / yy)
        records[j, H] = float(HALF / yy)
        records[j, OPACITY] = shows[0]
        records[j, S_MAX] = s_max
        records[j, Z] = depth
        if slopes.shape[0] > 0:
            slopes[j] = slopes_of(e, wp.float64(depth), view)
        records[j, INSTANCE] = instance
        records[j, Y_EXT] = y_ext
        records[j, Y_AT_EXT] = float(e.xy / xx) * x_ext
        all_rows = span_of(y, ROOM * y_ext + SLACK)
        all_columns = span_of(x, ROOM * x_ext + SLACK)
        rows = within(all_rows, view.tile_top, view.tiles_y)
        columns = within(all_columns, view.tile_left, view.tiles_x)
        total = wp.max(rows[1] - rows[0] + 1, 0) * wp.max(columns[1] - columns[0] + 1, 0)
        colour = wp.vec3(0.0)
        if total > 0:
            colour = harmonics(sh, i, sh.shape[1], sight * (1.0 / wp.max(wp.length(sight), TINY)))
        if total > 0 and wp.isfinite(colour):
            counts[j] = total
            note_reach(records, j, all_rows, all_columns, reach)
            depth_keys[j] = wp.cast(depth, int)
            records[j, RED] = wp.max(colour[0], 0.0)
            records[j, GREEN] = wp.max(colour[1], 0.0)
            records[j, BLUE] = wp.max(colour[2], 0.0)


@wp.func
def cull(depth_keys: wp.array[int], counts: wp.array[int], j: int):
    counts[j] = 0
    depth_keys[j] = CULLED


@wp.func
def gather(e: Ellipse, depth: wp.float64, logit: float, view: View, slots: wp.array2d[float], start: int, count: int):
    """Sum a splat's slots in fixed order and carry them from its record to its ellipse; logit is its opacity's."""
    o = sigmoid(logit)
    g = vec_gradients()
    for slot in range(start, start + count):
        for c in range(GRADIENTS):
            g[c] = g[c] + wp.float64(slots[slot, c])
    dilation = wp.float64(view.dilation)
    wide = dilated(e, view)
    yy = wide[1]
    det = wide[2]
    k = wp.sqrt(HALF * yy / det)
    m = e.xy / yy
    h = HALF / yy

    out = EllipseGradient()
    g_det = -HALF * g[G_K] * k / det  # det = det0 + dilation (xx0 + yy0 + dilation)
    g_trace = g_det
    out.det0 = g_det
    out.xy = g[G_M] / yy
    g_o = g[G_OPACITY]
    by_rest = wp.float64(0.0)
    if view.smoothing > 0.0:
        # opacity sqrt(less / det): its two derivatives by det0 nearly cancel for large splats, so they are taken together
        smoothing = wp.float64(view.smoothing)
        rest = dilation - smoothing
        less = wp.max(unsmoothed(e, view), LEAST)
        ratio = wp.sqrt(less / det)
        g_ratio = HALF * g_o * wp.float64(o) * ratio / det
        g_trace -= g_ratio
        by_rest = g_ratio * rest * det / less
        out.det0 += g_ratio * smoothing * (e.xx + e.yy + dilation + rest) / less
        g_o = g_o * ratio
    out.logit = float(g_o) * o * sigmoid(-logit)  # 1 - o, which loses its digits where o is nearly 1
    out.xx = g_trace * dilation + by_rest
    out.yy = (HALF * g[G_K] * k - g[G_M] * m - g[G_H] * h) / yy + g_trace * dilation + by_rest
    # depth at a pixel is that of the mean, and slopes times the way from there
    slopes = regressed(e, view)
    kept = calmed(e, depth)
    g_kept = g[G_ALONG] * slopes[0] + g[G_DOWN] * slopes[1]
    out.x = g[G_X] - kept * slopes[0] * g[G_Z]
    out.y = g[G_Y] - kept * slopes[1] * g[G_Z]
    out.depth = g[G_Z]
    if kept < ONE:
        out.depth += g_kept * kept / depth
        out.zz = -HALF * g_kept * kept / e.zz
    out.xz = kept * (yy * g[G_ALONG] - e.xy * g[G_DOWN]) / det
    out.yz = kept * (wide[0] * g[G_DOWN] - e.xy * g[G_ALONG]) / det
    out.xx -= out.xz * slopes[0]
    out.xy -= out.xz * slopes[1] + out.yz * slopes[0]
    out.yy -= out.yz * slopes[1]
    out.rgb = wp.vec3(wp.vec3d(g[G_RED], g[G_GREEN], g[G_BLUE]))
    return out


@wp.func
def colour_backward(sh: wp.array2d[wp.vec3], i: int, sight: wp.vec3, g_rgb: wp.vec3, g_sh: wp.array2d[wp.vec3]):
    """Write d loss / d sh of splat i; return d loss / d sight."""
    distance = wp.max(wp.length(sight), TINY)
    direction = sight / distance
    colour = harmonics(sh, i, sh.shape[1], direction)
    g = wp.vec3(g_rgb[0], g_rgb[1], g_rgb[2])
    for c in range(3):
        if colour[c] <= 0.0:
            g[c] = 0.0
    g_direction = harmonics_backward(sh, i, sh.shape[1], direction, g, g_sh)
    return (g_direction - direction * wp.dot(direction, g_direction)) / distance


@wp.func
def no_gradient(
    i: int, g_means: wp.array[wp.vec3], g_quats: wp.array[wp.vec4], g_log_scales: wp.array[wp.vec3],
    g_logit_opacities: wp.array[float], g_sh: wp.array2d[wp.vec3],
):  # fmt: skip
    g_means[i] = wp.vec3(0.0)
    g_quats[i] = wp.vec4(0.0)
    g_log_scales[i] = wp.vec3(0.0)
    g_logit_opacities[i] = 0.0
    for b in range(g_sh.shape[1]):
        g_sh[i, b] = wp.vec3(0.0)
