"""Compositing for CUDA: a block takes a tile, a thread one of its pixels.

The block walks its tile's entries together. In backward it sums every entry's gradient over its pixels with a tile reduction, and
one thread writes the slot: no atomics, so the same bits every time. Made per tile size: with tiles of one pixel and blocks of one
thread the same kernels run on the CPU, where the tests hold them against the lane kernels and the oracle.
"""

from functools import cache

import warp as wp

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
    GREEN,
    INSTANCE,
    MEDIAN,
    OPACITY,
    RED,
    S_MAX,
    WHO,
    X_REST,
    Y_REST,
    H,
    K,
    M,
    Wanted,
    Window,
    X,
    Y,
    Z,
)

OPTIONS = {"enable_backward": False}


@cache
def composite_blocks(wanted: Wanted, tile_size: int):
    """The forward kernel for tiles of `tile_size` pixels square."""

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def composite_blocks_forward(
        tile_starts: wp.array[int], ids: wp.array[int], records: wp.array2d[float], features: wp.array2d[float], channels: int,
        window: Window, alpha_max: float, termination: float,
        planes: wp.array3d[float], picks: wp.array3d[float], last: wp.array2d[int],
    ):  # fmt: skip
        tile, thread = wp.tid()
        px = (tile % window.tiles_x) * wp.static(tile_size) + thread % wp.static(tile_size)
        py = (tile // window.tiles_x) * wp.static(tile_size) + thread // wp.static(tile_size)
        x = float(window.left * wp.static(tile_size) + px) + 0.5
        y = float(window.top * wp.static(tile_size) + py) + 0.5
        t = float(1.0)
        colour = wp.vec3(0.0)
        z = float(0.0)
        weights = float(0.0)
        most = float(0.0)
        who = float(-1.0)
        median = float(0.0)
        if wp.static(wanted.channels):
            for c in range(channels):
                planes[wp.static(wanted.first_channel) + c, py, px] = 0.0
        stop = tile_starts[tile]
        for n in range(tile_starts[tile], tile_starts[tile + 1]):
            if t < termination:
                break
            i = ids[n]
            dy = (y - records[i, Y]) - records[i, Y_REST]
            u = ((x - records[i, X]) - records[i, X_REST] - records[i, M] * dy) * records[i, K]
            s = u * u + records[i, H] * dy * dy
            if s < records[i, S_MAX]:
                a = wp.min(records[i, OPACITY] * wp.exp(-s), alpha_max)
                w = t * a
                colour += w * wp.vec3(records[i, RED], records[i, GREEN], records[i, BLUE])
                if wp.static(wanted.depth):
                    z += w * records[i, Z]
                    weights += w
                if wp.static(wanted.channels):  # any number of them: kept in the planes, where neighbours' lie side by side
                    for c in range(channels):
                        p = wp.static(wanted.first_channel) + c
                        planes[p, py, px] = planes[p, py, px] + w * features[i, c]
                if wp.static(wanted.median):  # noqa: SIM102 - a static branch and a dynamic one
                    if t >= 0.5 and t - w < 0.5:
                        median = records[i, Z]
                if wp.static(wanted.instance):  # noqa: SIM102 - a static branch and a dynamic one
                    if w > most:
                        most = w
                        who = records[i, INSTANCE]
                t -= w
                stop = n + 1
        planes[0, py, px] = t
        planes[1, py, px] = colour[0]
        planes[2, py, px] = colour[1]
        planes[3, py, px] = colour[2]
        last[py, px] = stop
        if wp.static(wanted.depth):
            planes[4, py, px] = z
            planes[5, py, px] = weights
        if wp.static(wanted.median):
            picks[MEDIAN, py, px] = median
        if wp.static(wanted.instance):
            picks[WHO, py, px] = who

    return composite_blocks_forward


@cache
def composite_blocks_gradient(wanted: Wanted, tile_size: int):
    """The backward kernel for tiles of `tile_size` pixels square; arguments as `composite_gradient`, per pixel instead of per row."""

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def composite_blocks_backward(
        tile_starts: wp.array[int], ids: wp.array[int], slot_of: wp.array[int], records: wp.array2d[float],
        features: wp.array2d[float], channels: int, window: Window, alpha_max: float,
        planes: wp.array3d[float], grads: wp.array3d[float], last: wp.array2d[int],
        slots: wp.array2d[float], channel_slots: wp.array2d[float],
    ):  # fmt: skip
        tile, thread = wp.tid()
        px = (tile % window.tiles_x) * wp.static(tile_size) + thread % wp.static(tile_size)
        py = (tile // window.tiles_x) * wp.static(tile_size) + thread // wp.static(tile_size)
        x = float(window.left * wp.static(tile_size) + px) + 0.5
        y = float(window.top * wp.static(tile_size) + py) + 0.5
        start = tile_starts[tile]
        count = tile_starts[tile + 1] - start
        t = planes[0, py, px]
        rest = grads[0, py, px]
        stop = last[py, px]
        g = wp.vec3(grads[1, py, px], grads[2, py, px], grads[3, py, px])
        gz = float(0.0)
        gw = float(0.0)
        if wp.static(wanted.depth):
            gz = grads[4, py, px]
            gw = grads[5, py, px]
        for back in range(count):
            n = start + count - 1 - back
            i = ids[n]
            k = records[i, K]
            m = records[i, M]
            h = records[i, H]
            opacity = records[i, OPACITY]
            dy = (y - records[i, Y]) - records[i, Y_REST]
            offset = (x - records[i, X]) - records[i, X_REST] - m * dy
            u = offset * k
            s = u * u + h * dy * dy
            w = float(0.0)
            de = float(0.0)
            if n < stop and s < records[i, S_MAX]:
                e = wp.exp(-s)
                a = wp.min(opacity * e, alpha_max)
                inverse = 1.0 / (1.0 - a)
                t = t * inverse
                w = t * a
                d = wp.dot(g, wp.vec3(records[i, RED], records[i, GREEN], records[i, BLUE]))
                if wp.static(wanted.channels):
                    for c in range(channels):
                        d += grads[wp.static(wanted.first_channel) + c, py, px] * features[i, c]
                if wp.static(wanted.depth):
                    d += gz * records[i, Z] + gw
                if opacity * e < alpha_max:
                    de = (t * d - rest * inverse) * e
                rest += w * d
            ds = -opacity * de
            # every thread of the block takes part in the sums, whether or not its pixel saw the splat
            sum_x = wp.tile_sum(wp.tile(-2.0 * k * k * offset * ds))
            sum_y = wp.tile_sum(wp.tile((2.0 * k * k * m * offset - 2.0 * h * dy) * ds))
            sum_k = wp.tile_sum(wp.tile(2.0 * k * offset * offset * ds))
            sum_m = wp.tile_sum(wp.tile(-2.0 * k * k * offset * dy * ds))
            sum_h = wp.tile_sum(wp.tile(dy * dy * ds))
            sum_o = wp.tile_sum(wp.tile(de))
            sum_r = wp.tile_sum(wp.tile(w * g[0]))
            sum_g = wp.tile_sum(wp.tile(w * g[1]))
            sum_b = wp.tile_sum(wp.tile(w * g[2]))
            sum_z = wp.tile_sum(wp.tile(w * gz))
            slot = slot_of[n]
            if wp.static(wanted.channels):
                for c in range(channels):
                    sum_c = wp.tile_sum(wp.tile(w * grads[wp.static(wanted.first_channel) + c, py, px]))
                    if thread == 0:
                        channel_slots[slot, c] = sum_c[0]
            if thread == 0:
                slots[slot, G_X] = sum_x[0]
                slots[slot, G_Y] = sum_y[0]
                slots[slot, G_K] = sum_k[0]
                slots[slot, G_M] = sum_m[0]
                slots[slot, G_H] = sum_h[0]
                slots[slot, G_OPACITY] = sum_o[0]
                slots[slot, G_RED] = sum_r[0]
                slots[slot, G_GREEN] = sum_g[0]
                slots[slot, G_BLUE] = sum_b[0]
                slots[slot, G_Z] = sum_z[0]

    return composite_blocks_backward
