"""Front-to-back compositing on lane vectors, for the CPU: a thread takes a band of tiles, a lane vector one row of one.

A tile's list is gone through in batches of BATCH entries. First the entries, a lane a row: which rows each meets, as bits, and two numbers
for each row (`rows.rows_met`). Then the rows, a lane a pixel: transmittance and colours stay in registers while a row goes through the bits
of the entries that it meets. So the inner loop has no test of its own, no row is drawn in vain, and what is far in memory is read by a
loop whose ends are known.

Planes (`types.Wanted`) are `[rows, tiles_x]` lane vectors of one window: row-major images whose width is padded to the tile. Between
batches a tile's rows stand side by side in `state`, a few KiB a band that stay in the first cache. Kernels are made per set of outputs, so
that what was not asked for is not compiled in.

Backward (composite_backward.py) finds each transmittance by dividing the final one, so none may underflow. A lane whose neighbours see far
may meet any number of splats after it is dark. So between batches, which end early where entries are opaque, dark lanes are taken out:
their transmittance is kept aside with the place in the list, and goes on as 0, which costs nothing; backward brings it back at that place.
"""

from functools import cache

import warp as wp

from render.kernels.lanewise import below, cut, greater, largest, least, lesser, voted
from render.kernels.rows import ROLLED, corner_of, depth_along, exp_of, from_corner, rows_met
from render.kernels.types import BLUE, GREEN, INSTANCE, MEDIAN, OPACITY, RED, S_MAX, TILE, WHO, K, Wanted, Window, lanes

BATCH = wp.constant(24)  # entries between looks for dark lanes: as many as a float's bits
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
        tile_starts: wp.array[int], ids: wp.array[int], records: wp.array[lanes], slopes: wp.array[wp.vec2],
        features: wp.array2d[float], channels: int,
        window: Window, bands: int, alpha_max: float, termination: float,
        columns: wp.array[lanes], state: wp.array3d[lanes], held: wp.array[lanes], corners: wp.array[wp.vec3],
        terms: wp.array[lanes], numbers: wp.array[float],
        planes: wp.array3d[lanes], picks: wp.array3d[lanes], last: wp.array2d[int], dark_at: wp.array2d[lanes],
        first: int,
    ):  # fmt: skip
        """columns: 0 to 15, from memory, since the compiler takes a constant ramp apart.
        state `[bands, HELD + channels, 16]`: transmittance, red, green, blue, sum of w z, sum of w, instance, its lead, where in the
        tile's list the lane went dark, its transmittance then, median depth, channels.
        held, corners `[bands * BATCH]`: the records of the batch's entries, and their slopes as of `rows.from_corner`; terms
        `[bands * BATCH * 2]`: their exponents' terms by row, and the same memory as numbers.
        """
        band = first + wp.tid()
        column = columns[0]
        tiles = window.tiles_x * window.tiles_y
        for tile in range(band * tiles // bands, (band + 1) * tiles // bands):
            tx, row0, x0, y0 = corner_of(window, tile)
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
                    ridge, across, met = rows_met(record, x0, y0, column, lanes(bit))
                    meets = meets + met
                    held[band * BATCH + count] = record + lanes(0.0)
                    if wp.static(wanted.depths):
                        corners[band * BATCH + count] = from_corner(slopes[ids[base + count]], record, x0, y0)
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
                                w = wp.cw_mul(t, cut(s, record[S_MAX], least(exp_minus(s) * record[OPACITY], alpha_max)))
                                red = red + w * record[RED]
                                green = green + w * record[GREEN]
                                blue = blue + w * record[BLUE]
                                if wp.static(wanted.depths):
                                    far = depth_along(corners[band * BATCH + n], column, r)
                                if wp.static(wanted.depth):
                                    state[band, 4, r] = state[band, 4, r] + wp.cw_mul(w, far)
                                    state[band, 5, r] = state[band, 5, r] + w
                                if wp.static(wanted.channels):
                                    for c in range(channels):
                                        state[band, HELD + c, r] = state[band, HELD + c, r] + w * features[ids[base + n], c]
                                if wp.static(wanted.median):
                                    here = wp.cw_mul(below(0.5, t - w), lanes(1.0) - below(0.5, t))
                                    state[band, 10, r] = state[band, 10, r] + wp.cw_mul(here, far)
                                if wp.static(wanted.instance):
                                    who, lead = voted(state[band, 6, r], state[band, 7, r], record[INSTANCE], w)
                                    state[band, 6, r] = who
                                    state[band, 7, r] = lead
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
