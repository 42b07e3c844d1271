"""Front-to-back compositing on lane vectors, and its backward, for the CPU: a thread takes a tile, a lane vector one of its rows.

Planes are `[rows, tiles_x]` lane vectors: plain row-major images whose width is padded to the tile. Kernels are made per set of
outputs, so that what was not asked for is not compiled in. Backward runs back to front from a stored last entry per row: the
front-to-back form (total minus prefix) cancels in float32.
"""

from functools import cache

import warp as wp

from render.kernels.types import (
    BLUE,
    CS,
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
    K2H,
    OPACITY,
    OPTIONS,
    RED,
    S_MAX,
    SLACK,
    TILE,
    Y_EXT,
    H,
    K,
    M,
    X,
    Y,
    Z,
    lanes,
)

LAST = wp.constant(TILE - 1)
WIDTH = wp.constant(float(TILE - 1))
EARLY = wp.constant(16)  # entries between two looks at whether the whole tile has terminated


@wp.func
def step(x: lanes):
    """1 where x > 0, else 0 (x of ordinary size)."""
    return wp.min(wp.max(x * 1.0e30, lanes(0.0)), lanes(1.0))


@wp.func
def ramp():
    v = lanes()
    for c in range(TILE):
        v[c] = float(c)
    return v


@wp.func
def exp_series(z: lanes):
    """exp(-z) for z in [0, 0.75]: Taylor to degree 6, relative error 2e-5 at the end."""
    tail = lanes(0.041666668) - wp.cw_mul(z, lanes(0.008333334) - z * 0.00138889)
    return lanes(1.0) - z + wp.cw_mul(wp.cw_mul(z, z), lanes(0.5) - wp.cw_mul(z, lanes(0.16666667) - wp.cw_mul(z, tail)))


@wp.func
def row_range(records: wp.array2d[float], i: int, px: float, py: float):
    """First and last row of a tile that the ellipse reaches within the tile's columns; px, py: its centre from the tile's first pixel."""
    m = records[i, M]
    k2h = records[i, K2H]
    cs = records[i, CS]
    inv_c = records[i, INV_C]
    slope = records[i, K] * records[i, K] * m * inv_c
    x_at_ext = m * records[i, Y_EXT]
    left = -px - SLACK
    right = WIDTH - px + SLACK
    dx_low = wp.clamp(x_at_ext, left, right)
    dx_high = wp.clamp(-x_at_ext, left, right)
    low = slope * dx_low + wp.sqrt(wp.max(cs - k2h * dx_low * dx_low, 0.0)) * inv_c + SLACK
    high = slope * dx_high - wp.sqrt(wp.max(cs - k2h * dx_high * dx_high, 0.0)) * inv_c - SLACK
    return wp.vec2i(wp.max(0, int(wp.ceil(py + high))), wp.min(LAST, int(wp.floor(py + low))))


@cache
def composite(depth: bool, instance: bool, squarings: int):
    """The forward kernel. exp(-s) is `exp_series(s / 2^squarings)`, squared that often: 3 for cutoffs down to 1/400, 5 to 1e-10."""
    scale = 0.5**squarings

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def composite_forward(
        tile_starts: wp.array[int], ids: wp.array[int], records: wp.array2d[float],
        tiles_x: int, alpha_max: float, termination: float,
        out_t: wp.array2d[lanes], out_r: wp.array2d[lanes], out_g: wp.array2d[lanes], out_b: wp.array2d[lanes],
        out_z: wp.array2d[lanes], out_w: wp.array2d[lanes], out_instance: wp.array2d[lanes], best: wp.array2d[lanes], last: wp.array2d[int],
        first: int,
    ):  # fmt: skip
        tile = first + wp.tid()
        tx = tile % tiles_x
        row0 = (tile // tiles_x) * TILE
        x0 = float(tx * TILE) + 0.5
        y0 = float(row0) + 0.5
        column = ramp()
        start = tile_starts[tile]
        for r in range(TILE):
            out_t[row0 + r, tx] = lanes(1.0)
            out_r[row0 + r, tx] = lanes(0.0)
            out_g[row0 + r, tx] = lanes(0.0)
            out_b[row0 + r, tx] = lanes(0.0)
            last[row0 + r, tx] = start
            if wp.static(depth):
                out_z[row0 + r, tx] = lanes(0.0)
                out_w[row0 + r, tx] = lanes(0.0)
            if wp.static(instance):
                out_instance[row0 + r, tx] = lanes(-1.0)
                best[row0 + r, tx] = lanes(0.0)
        row_max = lanes(1.0)
        for n in range(start, tile_starts[tile + 1]):
            if (n - start) % EARLY == EARLY - 1:
                for r in range(TILE):
                    row_max[r] = wp.max(out_t[row0 + r, tx])
                if wp.max(row_max) < termination:
                    break
            i = ids[n]
            px = records[i, X] - x0
            py = records[i, Y] - y0
            k = records[i, K]
            m = records[i, M]
            h = records[i, H]
            opacity = records[i, OPACITY]
            s_max = records[i, S_MAX]
            red = records[i, RED]
            green = records[i, GREEN]
            blue = records[i, BLUE]
            rows = row_range(records, i, px, py)
            for r in range(rows[0], rows[1] + 1):
                if row_max[r] >= termination:
                    dy = float(r) - py
                    u = (column - lanes(px + m * dy)) * k
                    s = wp.cw_mul(u, u) + lanes(h * dy * dy)
                    e = exp_series(wp.min(s, lanes(s_max)) * wp.static(scale))
                    for _q in range(wp.static(squarings)):
                        e = wp.cw_mul(e, e)
                    a = wp.cw_mul(wp.min(e * opacity, lanes(alpha_max)), step(lanes(s_max) - s))
                    t = out_t[row0 + r, tx]
                    w = wp.cw_mul(t, a)
                    out_r[row0 + r, tx] = out_r[row0 + r, tx] + w * red
                    out_g[row0 + r, tx] = out_g[row0 + r, tx] + w * green
                    out_b[row0 + r, tx] = out_b[row0 + r, tx] + w * blue
                    if wp.static(depth):
                        out_z[row0 + r, tx] = out_z[row0 + r, tx] + w * records[i, Z]
                        out_w[row0 + r, tx] = out_w[row0 + r, tx] + w
                    if wp.static(instance):
                        more = step(w - best[row0 + r, tx])
                        was = out_instance[row0 + r, tx]
                        out_instance[row0 + r, tx] = was + wp.cw_mul(more, lanes(records[i, INSTANCE]) - was)
                        best[row0 + r, tx] = wp.max(best[row0 + r, tx], w)
                    out_t[row0 + r, tx] = t - w
                    last[row0 + r, tx] = n + 1

    return composite_forward


@cache
def composite_gradient(depth: bool, squarings: int):
    """The backward kernel: writes one gradient slot for every entry of every tile, on every path."""
    scale = 0.5**squarings

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def composite_backward(
        tile_starts: wp.array[int], ids: wp.array[int], slot_of: wp.array[int], records: wp.array2d[float],
        tiles_x: int, alpha_max: float,
        g_r: wp.array2d[lanes], g_g: wp.array2d[lanes], g_b: wp.array2d[lanes], g_z: wp.array2d[lanes], g_w: wp.array2d[lanes],
        last: wp.array2d[int],
        t_run: wp.array2d[lanes], rest_run: wp.array2d[lanes], slots: wp.array2d[float],
        first: int,
    ):  # fmt: skip
        """With d_i = c_i . g and rest_i the sum over j behind i of w_j d_j: dL/da_i = T_i d_i - rest_i / (1 - a_i).
        t_run starts as the final transmittance, rest_run as final transmittance times its own gradient."""
        tile = first + wp.tid()
        tx = tile % tiles_x
        row0 = (tile // tiles_x) * TILE
        x0 = float(tx * TILE) + 0.5
        y0 = float(row0) + 0.5
        column = ramp()
        one = lanes(1.0)
        start = tile_starts[tile]
        stop = start
        for r in range(TILE):
            stop = wp.max(stop, last[row0 + r, tx])
        for n in range(stop, tile_starts[tile + 1]):
            slot = slot_of[n]
            for c in range(GRADIENTS):
                slots[slot, c] = 0.0
        for back in range(stop - start):
            n = stop - 1 - back
            i = ids[n]
            px = records[i, X] - x0
            py = records[i, Y] - y0
            k = records[i, K]
            m = records[i, M]
            h = records[i, H]
            opacity = records[i, OPACITY]
            s_max = records[i, S_MAX]
            red = records[i, RED]
            green = records[i, GREEN]
            blue = records[i, BLUE]
            sum_r = lanes(0.0)
            sum_g = lanes(0.0)
            sum_b = lanes(0.0)
            sum_z = lanes(0.0)
            sum_o = lanes(0.0)
            sum_t = lanes(0.0)  # dL/ds * t, with t = dx - m dy
            sum_tt = lanes(0.0)
            sum_ty = lanes(0.0)
            sum_y = lanes(0.0)
            sum_yy = lanes(0.0)
            rows = row_range(records, i, px, py)
            for r in range(rows[0], rows[1] + 1):
                if n < last[row0 + r, tx]:
                    dy = float(r) - py
                    offset = column - lanes(px + m * dy)
                    u = offset * k
                    s = wp.cw_mul(u, u) + lanes(h * dy * dy)
                    e = exp_series(wp.min(s, lanes(s_max)) * wp.static(scale))
                    for _q in range(wp.static(squarings)):
                        e = wp.cw_mul(e, e)
                    e = wp.cw_mul(e, step(lanes(s_max) - s))
                    full = e * opacity
                    a = wp.min(full, lanes(alpha_max))
                    free = step(lanes(alpha_max) - full)
                    inverse = wp.cw_div(one, one - a)
                    t = wp.cw_mul(t_run[row0 + r, tx], inverse)
                    w = wp.cw_mul(t, a)
                    gr = g_r[row0 + r, tx]
                    gg = g_g[row0 + r, tx]
                    gb = g_b[row0 + r, tx]
                    d = gr * red + gg * green + gb * blue
                    if wp.static(depth):
                        gz = g_z[row0 + r, tx]
                        d = d + gz * records[i, Z] + g_w[row0 + r, tx]
                        sum_z = sum_z + wp.cw_mul(w, gz)
                    rest = rest_run[row0 + r, tx]
                    de = wp.cw_mul(wp.cw_mul(wp.cw_mul(t, d) - wp.cw_mul(rest, inverse), free), e)
                    sum_r = sum_r + wp.cw_mul(w, gr)
                    sum_g = sum_g + wp.cw_mul(w, gg)
                    sum_b = sum_b + wp.cw_mul(w, gb)
                    sum_o = sum_o + de
                    dt = wp.cw_mul(de, offset)
                    sum_t = sum_t + dt
                    sum_tt = sum_tt + wp.cw_mul(dt, offset)
                    sum_ty = sum_ty + dt * dy
                    sum_y = sum_y + de * dy
                    sum_yy = sum_yy + de * (dy * dy)
                    rest_run[row0 + r, tx] = rest + wp.cw_mul(w, d)
                    t_run[row0 + r, tx] = t
            k2 = -2.0 * k * k * opacity  # dL/ds = -opacity * de throughout
            of_t = wp.dot(sum_t, one)
            slot = slot_of[n]
            slots[slot, G_X] = -k2 * of_t
            slots[slot, G_Y] = k2 * m * of_t + 2.0 * h * opacity * wp.dot(sum_y, one)
            slots[slot, G_K] = -2.0 * k * opacity * wp.dot(sum_tt, one)
            slots[slot, G_M] = -k2 * wp.dot(sum_ty, one)
            slots[slot, G_H] = -opacity * wp.dot(sum_yy, one)
            slots[slot, G_OPACITY] = wp.dot(sum_o, one)
            slots[slot, G_RED] = wp.dot(sum_r, one)
            slots[slot, G_GREEN] = wp.dot(sum_g, one)
            slots[slot, G_BLUE] = wp.dot(sum_b, one)
            slots[slot, G_Z] = wp.dot(sum_z, one)

    return composite_backward
