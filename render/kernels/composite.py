"""Front-to-back compositing on lane vectors, and its backward, for the CPU: a thread takes a band of tiles, a lane vector one row of one.

Planes (`types.Wanted`) are `[rows, tiles_x]` lane vectors of one window: row-major images whose width is padded to the tile. While a
tile is worked on, its rows stand side by side in `state`, a few KiB a band that stay in the first cache: straight from the planes, every
row would be another page. Kernels are made per set of outputs, so that what was not asked for is not compiled in. Backward runs back to
front from a stored last entry per row: the front-to-back form (total minus prefix) cancels in float32.

Backward finds each transmittance by dividing the final one, so none may underflow. A lane whose neighbours see far may meet any
number of splats after it is dark. So every LOOK entries, and sooner where they are opaque, dark lanes are taken out: their transmittance
is kept aside with the place in the list, and goes on as 0, which costs nothing an entry; backward brings it back at that place.
"""

from functools import cache

import warp as wp

from render.kernels.rows import ROLLED, WIDTH, before, below, exp_of, farther, greater, largest, lesser, row_range, shown
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
    MEDIAN,
    OPACITY,
    RED,
    S_MAX,
    TILE,
    WHO,
    H,
    K,
    M,
    Wanted,
    Window,
    X,
    Y,
    Z,
    lanes,
)

BATCH = wp.constant(24)  # entries between looks for dark lanes: as many as a float's bits
ROUNDING = wp.constant(1.00001)
FAINTEST = wp.constant(1.0e-20)  # times termination, and once more 1 - alpha_max, is a float yet
vec_rows = wp.types.vector(length=TILE, dtype=wp.int32)
HELD = wp.constant(11)  # rows of working state a tile before its channels
NEVER = wp.constant(16777216.0)  # the place in a tile's list of a lane that never went dark; floats count exactly up to it


@cache
def composite(wanted: Wanted, squarings: int, gradients: bool):
    """The forward kernel; last and dark_at are left for backward where `gradients` are wanted. exp(-s) is `exp_of(squarings)`."""
    exp_minus = exp_of(squarings)

    @wp.kernel(module="unique", module_options=ROLLED, enable_backward=False)
    def composite_forward(
        tile_starts: wp.array[int], ids: wp.array[int], records: wp.array[lanes], features: wp.array2d[float], channels: int,
        window: Window, bands: int, alpha_max: float, termination: float,
        columns: wp.array[lanes], state: wp.array3d[lanes], held: wp.array[lanes], terms: wp.array[lanes], numbers: wp.array[float],
        planes: wp.array3d[lanes], picks: wp.array3d[lanes], last: wp.array2d[int], dark_at: wp.array2d[lanes],
        first: int,
    ):  # fmt: skip
        """columns: 0 to 15, from memory, since the compiler takes a constant ramp apart.
        state `[bands, HELD + channels, 16]`: transmittance, red, green, blue, sum of w z, sum of w, instance, its weight, where in the
        tile's list the lane went dark, its transmittance then, median depth, channels.
        held `[bands * BATCH]`: the records of the batch's entries; terms `[bands * BATCH * 2]`: their exponents' terms by row, and the same
        memory as numbers.
        """
        band = first + wp.tid()
        column = columns[0]
        tiles = window.tiles_x * window.tiles_y
        for tile in range(band * tiles // bands, (band + 1) * tiles // bands):
            tx = tile % window.tiles_x
            ty = tile // window.tiles_x
            row0 = ty * TILE
            x0 = float((window.left + tx) * TILE) + 0.5
            y0 = float((window.top + ty) * TILE) + 0.5
            start = tile_starts[tile]
            stop = tile_starts[tile + 1]
            for r in range(TILE):
                state[band, 0, r] = lanes(1.0)
                for p in range(1, wp.static(8 if wanted.instance else 6 if wanted.depth else 4)):
                    state[band, p, r] = lanes(0.0)
                if wp.static(wanted.median):
                    state[band, 10, r] = lanes(0.0)
                if wp.static(wanted.channels):
                    for c in range(channels):
                        state[band, HELD + c, r] = lanes(0.0)
                if wp.static(wanted.instance):
                    state[band, 6, r] = lanes(-1.0)
                if wp.static(gradients):
                    state[band, 8, r] = lanes(NEVER)
                state[band, 9, r] = lanes(0.0)
            light = lanes(1.0)  # by row: of its brightest lane
            row_last = vec_rows(start)
            base = int(start)
            while base < stop:
                strength = float(1.0)  # at most so much weaker does any lane become in this batch
                count = int(0)
                meets = lanes(0.0)  # by row: the entries that it meets, as the bits of a whole number
                bit = float(1.0)
                while count < BATCH and base + count < stop and strength >= FAINTEST:
                    record = records[ids[base + count]]
                    strength *= 1.0 - lesser(record[OPACITY], alpha_max)
                    k = record[K]
                    dy = column - lanes(record[Y] - y0)
                    ridge = (lanes(record[X] - x0) + dy * record[M]) * k
                    across = wp.cw_mul(dy, dy) * record[H]
                    beyond = farther(ridge - lanes(k * WIDTH), lanes(0.0) - ridge)
                    meets = meets + shown(wp.cw_mul(beyond, beyond) + across, record[S_MAX] * ROUNDING, lanes(bit), bit)
                    held[band * BATCH + count] = record + lanes(0.0)
                    terms[2 * (band * BATCH + count)] = ridge
                    terms[2 * (band * BATCH + count) + 1] = across
                    bit *= 2.0
                    count += 1
                brightest = float(0.0)
                r = int(0)
                while r < TILE:
                    if light[r] > 0.0:
                        t = state[band, 0, r]
                        dark = below(termination, t)
                        kept = wp.cw_mul(dark, t)
                        if wp.static(gradients):
                            state[band, 8, r] = wp.min(state[band, 8, r], lanes(NEVER) + dark * (float(base - start) - NEVER))
                        state[band, 9, r] = state[band, 9, r] + kept
                        t = t - kept
                        light[r] = largest(t)
                        brightest = greater(brightest, light[r])
                        bits = int(meets[r])
                        if light[r] > 0.0 and bits > 0:
                            red = state[band, 1, r]
                            green = state[band, 2, r]
                            blue = state[band, 3, r]
                            while bits != 0:
                                n = wp.bit_count((bits & (0 - bits)) - 1)
                                bits = bits & (bits - 1)
                                record = held[band * BATCH + n]
                                at = 2 * TILE * (band * BATCH + n) + r
                                u = column * record[K] - lanes(numbers[at])
                                s = wp.cw_mul(u, u) + lanes(numbers[at + TILE])
                                w = wp.cw_mul(t, shown(s, record[S_MAX], exp_minus(s) * record[OPACITY], alpha_max))
                                red = red + w * record[RED]
                                green = green + w * record[GREEN]
                                blue = blue + w * record[BLUE]
                                if wp.static(wanted.depth):
                                    state[band, 4, r] = state[band, 4, r] + w * record[Z]
                                    state[band, 5, r] = state[band, 5, r] + w
                                if wp.static(wanted.channels):
                                    for c in range(channels):
                                        state[band, HELD + c, r] = state[band, HELD + c, r] + w * features[ids[base + n], c]
                                if wp.static(wanted.median):
                                    here = wp.cw_mul(below(0.5, t - w), lanes(1.0) - below(0.5, t))
                                    state[band, 10, r] = state[band, 10, r] + here * record[Z]
                                if wp.static(wanted.instance):
                                    most = state[band, 7, r]
                                    leads = wp.min(wp.max((w - most) * 1.0e30, lanes(0.0)), lanes(1.0))
                                    state[band, 6, r] = state[band, 6, r] + wp.cw_mul(leads, lanes(record[INSTANCE]) - state[band, 6, r])
                                    state[band, 7, r] = wp.max(most, w)
                                t = t - w
                            state[band, 1, r] = red
                            state[band, 2, r] = green
                            state[band, 3, r] = blue
                            row_last[r] = base + n + 1
                        state[band, 0, r] = t
                    r += 1
                if brightest <= 0.0:
                    break
                base += count
            for r in range(TILE):
                if wp.static(gradients):
                    last[row0 + r, tx] = row_last[r]
                    dark_at[row0 + r, tx] = state[band, 8, r]
                planes[0, row0 + r, tx] = state[band, 0, r] + state[band, 9, r]
                for p in range(1, wp.static(wanted.first_channel)):
                    planes[p, row0 + r, tx] = state[band, p, r]
                if wp.static(wanted.channels):
                    for c in range(channels):
                        planes[wp.static(wanted.first_channel) + c, row0 + r, tx] = state[band, HELD + c, r]
                if wp.static(wanted.median):
                    picks[MEDIAN, row0 + r, tx] = state[band, 10, r]
                if wp.static(wanted.instance):
                    picks[WHO, row0 + r, tx] = state[band, 6, r]

    return composite_forward


@cache
def composite_gradient(wanted: Wanted, squarings: int):
    """The backward kernel: writes one gradient slot for every entry of every tile, on every path, and one of its channels."""
    exp_minus = exp_of(squarings)

    @wp.kernel(module="unique", module_options=ROLLED, enable_backward=False)
    def composite_backward(
        tile_starts: wp.array[int], ids: wp.array[int], slot_of: wp.array[int], records: wp.array[lanes],
        features: wp.array2d[float], channels: int, window: Window, bands: int, alpha_max: float,
        columns: wp.array[lanes], state: wp.array3d[lanes],
        planes: wp.array3d[lanes], grads: wp.array3d[lanes], last: wp.array2d[int], dark_at: wp.array2d[lanes],
        slots: wp.array2d[float], channel_slots: wp.array2d[float], sums: wp.array2d[lanes],
        first: int,
    ):  # fmt: skip
        """With d_i = c_i . g and rest_i the sum over j behind i of w_j d_j: dL/da_i = T_i d_i - rest_i / (1 - a_i).

        planes: as forward left them; grads: the same of the loss's derivatives, but T dL/dT for the first.
        state `[bands, HELD + channels, 16]`: transmittance so far, rest (both start from the end: final transmittance, and that times
        its own gradient; both 0 where the lane was dark), then the gradients of red, green, blue, sum of w z, sum of w, where it went
        dark, from HELD on those of the channels. sums `[bands, channels]`, zeroed before: an entry's sums of w g of the channels.
        """
        band = first + wp.tid()
        column = columns[0]
        one = lanes(1.0)
        tiles = window.tiles_x * window.tiles_y
        for tile in range(band * tiles // bands, (band + 1) * tiles // bands):
            tx = tile % window.tiles_x
            ty = tile // window.tiles_x
            row0 = ty * TILE
            x0 = float((window.left + tx) * TILE) + 0.5
            y0 = float((window.top + ty) * TILE) + 0.5
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
            next_rows = wp.vec2i(0, -1)
            if stop > start:
                next_rows = row_range(records[ids[stop - 1]], x0, y0)
            for back in range(stop - start):
                n = stop - 1 - back
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
                record = records[i]
                px = record[X] - x0
                py = record[Y] - y0
                k = record[K]
                m = record[M]
                h = record[H]
                s_max = record[S_MAX]
                opacity = record[OPACITY]
                red = record[RED]
                green = record[GREEN]
                blue = record[BLUE]
                sum_r = lanes(0.0)
                sum_g = lanes(0.0)
                sum_b = lanes(0.0)
                sum_z = lanes(0.0)
                sum_e = lanes(0.0)  # of dL/da e = -dL/ds / opacity
                sum_ey = lanes(0.0)
                sum_eyy = lanes(0.0)
                rows = wp.vec2i(next_rows[0], next_rows[1])  # a copy: plain assignment would be another name for the same variable
                next_rows = row_range(records[ids[wp.max(n - 1, start)]], x0, y0)
                # moments are taken about a point of the ridge amid these rows: about the centre, which may lie
                # hundreds of pixels away, the sums of a needle would cancel
                middle = 0.5 * float(rows[0] + rows[1])
                for r in range(rows[0], rows[1] + 1):
                    if n < row_last[r]:
                        dy = float(r) - py
                        u = column * k - lanes(k * (px + m * dy))
                        s = wp.cw_mul(u, u) + lanes(h * dy * dy)
                        e = shown(s, s_max, exp_minus(s), 1.0)
                        full = e * opacity
                        a = wp.min(full, lanes(alpha_max))
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
                            d = d + gz * record[Z] + state[band, 6, r]
                            sum_z = sum_z + wp.cw_mul(w, gz)
                        rest = state[band, 1, r]
                        de = wp.cw_mul(wp.cw_mul(wp.cw_mul(t, d) - wp.cw_mul(rest, inverse), below(alpha_max, full)), e)
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
                xe = wp.cw_mul(x, sum_e)
                e0 = wp.dot(sum_e, one)
                ey = wp.dot(sum_ey, one)
                eyy = wp.dot(sum_eyy, one)
                xey = wp.dot(sum_ey, x)
                et = wp.dot(xe, one) - m * ey  # sums of e t, e t^2, e t dy, e dy, e dy^2, with t = dx - m dy
                ett = wp.dot(xe, x) - m * (2.0 * xey - m * eyy)
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
                slots[slot, G_RED] = wp.dot(sum_r, one)
                slots[slot, G_GREEN] = wp.dot(sum_g, one)
                slots[slot, G_BLUE] = wp.dot(sum_b, one)
                slots[slot, G_Z] = wp.dot(sum_z, one)

    return composite_backward
