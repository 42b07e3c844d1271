"""Backward of compositing on lane vectors, for the CPU: back to front, from each row's last entry and final transmittance.

The front-to-back form (total minus prefix) cancels in float32. Transmittance in front of an entry is what is behind it, divided by what the
entry lets through; lanes that `composite` took out as dark come back where they went dark. The sums of an entry over its rows go to a slot
of their own: no two threads ever add to one number.
"""

from functools import cache

import warp as wp

from render.kernels.composite import BATCH, HELD, vec_rows
from render.kernels.lanewise import before, cut, least, total, total_at
from render.kernels.rows import ROLLED, corner_of, depth_along, exp_of, from_corner, rows_met
from render.kernels.types import (
    BLUE,
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
    OPACITY,
    RED,
    S_MAX,
    TILE,
    X_REST,
    Y_REST,
    H,
    K,
    M,
    Wanted,
    Window,
    X,
    Y,
    lanes,
)

SUMS = wp.constant(12)
"""Lane vectors that are added up for an entry."""


@cache
def composite_gradient(wanted: Wanted, squarings: int):
    """The backward kernel: writes one gradient slot for every entry of every tile, on every path, and one of its channels."""
    exp_minus = exp_of(squarings)

    @wp.kernel(module="unique", module_options=ROLLED, enable_backward=False)
    def composite_backward(
        tile_starts: wp.array[int], ids: wp.array[int], slot_of: wp.array[int], records: wp.array[lanes], slopes: wp.array[wp.vec2],
        features: wp.array2d[float], channels: int, window: Window, bands: int, alpha_max: float,
        columns: wp.array[lanes], state: wp.array3d[lanes], terms: wp.array[lanes], numbers: wp.array[float],
        quarters: wp.array[wp.vec4], meets: wp.array[int],
        planes: wp.array3d[lanes], grads: wp.array3d[lanes], last: wp.array2d[int], dark_at: wp.array2d[lanes],
        slots: wp.array2d[float], channel_slots: wp.array2d[float], sums: wp.array2d[lanes],
        first: int,
    ):  # fmt: skip
        """With d_i = c_i . g and rest_i the sum over j behind i of w_j d_j: dL/da_i = T_i d_i - rest_i / (1 - a_i).

        planes: as forward left them; grads: the same of the loss's derivatives, but T dL/dT for the first.
        terms `[bands * (3 BATCH + SUMS)]`: records of the batch's entries, their exponents' terms by row, an entry's sums; the same memory
        as numbers and as quarters; meets `[bands * BATCH]`: the rows that the batch's entries meet, as bits.
        state `[bands, HELD + channels, 17]`: transmittance so far, rest (both start from the end: final transmittance, and that times
        its own gradient; both 0 where the lane was dark), then the gradients of red, green, blue, sum of w z, sum of w, where it went
        dark, from HELD on those of the channels. sums `[bands, channels]`, zeroed before: an entry's sums of w g of the channels.
        """
        band = first + wp.tid()
        column = columns[0]
        powers = columns[1]
        at = (3 * BATCH + SUMS) * band
        sums_at = at + 3 * BATCH
        one = lanes(1.0)
        tiles = window.tiles_x * window.tiles_y
        for tile in range(band * tiles // bands, (band + 1) * tiles // bands):
            tx, row0, x0, y0 = corner_of(window, tile)
            start = tile_starts[tile]
            stop = start
            row_last = vec_rows(start)
            for r in range(TILE):
                row_last[r] = last[row0 + r, tx]
                stop = wp.max(stop, last[row0 + r, tx])
            next_dark = lanes(-1.0)  # by column: the last place, before the one at hand, where a lane went dark
            for r in range(TILE):
                since = dark_at[row0 + r, tx]
                lit = wp.min(wp.max(since - lanes(float(stop - start - 1)), lanes(0.0)), one)
                state[band, 0, r] = wp.cw_mul(lit, planes[0, row0 + r, tx])
                state[band, 1, r] = wp.cw_mul(lit, grads[0, row0 + r, tx])
                for p in range(1, wp.static(wanted.first_channel)):
                    state[band, 1 + p, r] = grads[p, row0 + r, tx]
                if wp.static(wanted.channels):
                    for c in range(channels):
                        state[band, HELD + c, r] = grads[wp.static(wanted.first_channel) + c, row0 + r, tx]
                state[band, 7, r] = since
                next_dark = wp.max(next_dark, before(float(stop - start), since))
            brighten = wp.max(next_dark)
            for n in range(stop, tile_starts[tile + 1]):
                slot = slot_of[n]
                for c in range(GRADIENTS):
                    slots[slot, c] = 0.0
                if wp.static(wanted.channels):
                    for c in range(channels):
                        channel_slots[slot, c] = 0.0
            ends = lanes(0.0)  # by row: its last, counted from start
            for r in range(TILE):
                ends[r] = float(row_last[r] - start)
            top = int(stop)  # one past the batch's first: back to front
            while top > start:
                # all that the loop over an entry's rows hangs on is found before, for many: its end is mispredicted, and then
                # must not wait for far memory
                count = wp.min(BATCH, top - start)
                for q in range(count):
                    n = top - 1 - q
                    record = records[ids[n]]
                    ridge, across, met = rows_met(record, x0, y0, column, powers)
                    terms[at + q] = record + lanes(0.0)
                    terms[at + BATCH + 2 * q] = ridge
                    terms[at + BATCH + 2 * q + 1] = across
                    meets[BATCH * band + q] = int(total(cut(lanes(float(n - start)) - ends, 0.0, met)))
                for q in range(count):
                    n = top - 1 - q
                    if float(n + 1 - start) == brighten:
                        next_dark = lanes(-1.0)
                        for r in range(TILE):
                            since = state[band, 7, r]
                            off = since - lanes(brighten)
                            here = one - wp.min(wp.max(off, lanes(0.0) - off), one)
                            state[band, 0, r] = state[band, 0, r] + wp.cw_mul(here, planes[0, row0 + r, tx])
                            state[band, 1, r] = state[band, 1, r] + wp.cw_mul(here, grads[0, row0 + r, tx])
                            next_dark = wp.max(next_dark, before(brighten, since))
                        brighten = wp.max(next_dark)
                    i = ids[n]
                    record = terms[at + q]
                    bits = meets[BATCH * band + q]
                    rows = TILE * (at + BATCH + 2 * q)
                    px = (record[X] - x0) + record[X_REST]
                    py = (record[Y] - y0) + record[Y_REST]
                    k = record[K]
                    m = record[M]
                    if wp.static(wanted.depth):
                        corner = from_corner(slopes[i], record, x0, y0)
                    s_max = record[S_MAX]
                    opacity = record[OPACITY]
                    red = record[RED]
                    green = record[GREEN]
                    blue = record[BLUE]
                    sum_r = lanes(0.0)
                    sum_g = lanes(0.0)
                    sum_b = lanes(0.0)
                    sum_z = lanes(0.0)
                    sum_zy = lanes(0.0)
                    sum_e = lanes(0.0)  # of dL/da e = -dL/ds / opacity
                    sum_ey = lanes(0.0)
                    sum_eyy = lanes(0.0)
                    # moments are taken about a point of the ridge amid these rows: about the centre, which may lie
                    # hundreds of pixels away, the sums of a needle would cancel
                    middle = float(wp.bit_count((bits & (0 - bits)) - 1)) + 0.5 * float(wp.bit_count(bits) - 1)
                    while bits != 0:
                        r = wp.bit_count((bits & (0 - bits)) - 1)
                        bits = bits & (bits - 1)
                        u = column * k - lanes(numbers[rows + r])
                        s = wp.cw_mul(u, u) + lanes(numbers[rows + TILE + r])
                        e = cut(s, s_max, exp_minus(s))
                        full = e * opacity
                        a = least(full, alpha_max)
                        inverse = wp.cw_div(one, one - a)
                        t = wp.cw_mul(state[band, 0, r], inverse)
                        w = wp.cw_mul(t, a)
                        gr = state[band, 2, r]
                        gg = state[band, 3, r]
                        gb = state[band, 4, r]
                        d = gr * red + gg * green + gb * blue
                        if wp.static(wanted.channels):
                            for c in range(channels):
                                gc = state[band, HELD + c, r]
                                d = d + gc * features[i, c]
                                sums[band, c] = sums[band, c] + wp.cw_mul(w, gc)
                        if wp.static(wanted.depth):
                            gz = state[band, 5, r]
                            d = d + wp.cw_mul(gz, depth_along(corner, column, r)) + state[band, 6, r]
                            gz = wp.cw_mul(w, gz)
                            sum_z = sum_z + gz
                            sum_zy = sum_zy + gz * (float(r) - middle)
                        rest = state[band, 1, r]
                        de = wp.cw_mul(cut(full, alpha_max, wp.cw_mul(t, d) - wp.cw_mul(rest, inverse)), e)
                        y = float(r) - middle
                        sum_r = sum_r + wp.cw_mul(w, gr)
                        sum_g = sum_g + wp.cw_mul(w, gg)
                        sum_b = sum_b + wp.cw_mul(w, gb)
                        sum_e = sum_e + de
                        sum_ey = sum_ey + de * y
                        sum_eyy = sum_eyy + de * (y * y)
                        state[band, 1, r] = rest + wp.cw_mul(w, d)
                        state[band, 0, r] = t
                    from_centre = middle - py
                    x = column - lanes(px + m * from_centre)
                    # through memory: else the compiler mixes adding up the lanes into the loop above, which becomes four times slower
                    terms[sums_at] = sum_e
                    terms[sums_at + 1] = sum_ey
                    terms[sums_at + 2] = sum_eyy
                    terms[sums_at + 3] = wp.cw_mul(x, sum_e)
                    terms[sums_at + 4] = wp.cw_mul(x, sum_ey)
                    terms[sums_at + 5] = wp.cw_mul(x, wp.cw_mul(x, sum_e))
                    terms[sums_at + 6] = sum_r
                    terms[sums_at + 7] = sum_g
                    terms[sums_at + 8] = sum_b
                    if wp.static(wanted.depth):
                        terms[sums_at + 9] = sum_z
                        terms[sums_at + 10] = wp.cw_mul(column - lanes(record[X] - x0), sum_z)
                        terms[sums_at + 11] = sum_zy
                    e0 = total_at(quarters, sums_at)
                    ey = total_at(quarters, sums_at + 1)
                    eyy = total_at(quarters, sums_at + 2)
                    xey = total_at(quarters, sums_at + 4)
                    et = total_at(quarters, sums_at + 3) - m * ey  # sums of e t, e t^2, e t dy, e dy, e dy^2, with t = dx - m dy
                    ett = total_at(quarters, sums_at + 5) - m * (2.0 * xey - m * eyy)
                    ety = xey - m * eyy + from_centre * et
                    edy = ey + from_centre * e0
                    edyy = eyy + from_centre * (2.0 * ey + from_centre * e0)
                    k1 = record[K]
                    slope = 2.0 * k1 * k1 * opacity  # dL/ds = -opacity dL/da e throughout
                    slot = slot_of[n]
                    if wp.static(wanted.channels):
                        for c in range(channels):
                            channel_slots[slot, c] = wp.dot(sums[band, c], one)
                            sums[band, c] = lanes(0.0)
                    slots[slot, G_X] = slope * et
                    slots[slot, G_Y] = 2.0 * record[H] * opacity * edy - slope * m * et
                    slots[slot, G_K] = -2.0 * k1 * opacity * ett
                    slots[slot, G_M] = slope * ety
                    slots[slot, G_H] = -opacity * edyy
                    slots[slot, G_OPACITY] = e0
                    slots[slot, G_RED] = total_at(quarters, sums_at + 6)
                    slots[slot, G_GREEN] = total_at(quarters, sums_at + 7)
                    slots[slot, G_BLUE] = total_at(quarters, sums_at + 8)
                    if wp.static(wanted.depth):
                        gz_all = total_at(quarters, sums_at + 9)
                        slots[slot, G_Z] = gz_all
                        slots[slot, G_ALONG] = total_at(quarters, sums_at + 10)
                        slots[slot, G_DOWN] = total_at(quarters, sums_at + 11) + (middle - (record[Y] - y0)) * gz_all
                    else:
                        slots[slot, G_Z] = 0.0
                        slots[slot, G_ALONG] = 0.0
                        slots[slot, G_DOWN] = 0.0
                top -= count

    return composite_backward
