"""How alike pictures look on planes before one of them. A lane vector is 16 planes at one pixel, so that sums over squares of pixels are
sums of whole vectors."""

from functools import cache

import warp as wp

from render.kernels.lanewise import cut, greater, greater_of, lesser_of, roots, smallest
from render.kernels.types import OPTIONS, TILE, lanes, pixel_of, pixels_of

wp.set_module_options(OPTIONS)

PLANES = 96
"""Planes of a direction."""

CHUNKS = PLANES // TILE
"""Lane vectors of a pixel."""

NEAREST = wp.constant(0.1)
"""Metres before another picture from which on it may show a place."""

BEHIND = wp.constant(1.0e-3)
"""What depths are divided by at least."""


@wp.func
def numbers(chunk: int):
    """Which planes the lanes of a chunk are."""
    return lanes(float(TILE * chunk)) + lanes(0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0)


@wp.func
def part_of_row(item: int, stretch: int, width: int):
    """Of the at most `stretch` pixels of a row that an item does: the row, the first column, and the one behind the last."""
    parts = (width + stretch - 1) / stretch
    left = item % parts * stretch
    return item / parts, left, wp.min(left + stretch, width)


@wp.func
def matters(bounds: wp.array3d[float], y: int, x: int, chunk: int):
    """Whether a pixel has planes of a chunk between its bounds."""
    return bounds[0, y, x] < float(TILE * (chunk + 1)) and bounds[1, y, x] >= float(TILE * chunk)


@wp.func
def on_axis(motion: wp.array3d[float], o: int, axis: int, x: int, y: int, inverse_depths: lanes):
    base = motion[o, axis, 0] * float(x) + motion[o, axis, 1] * float(y) + motion[o, axis, 2]
    return lanes(base) + inverse_depths * motion[o, axis, 3]


# in C++ since Warp, which asks each index whether it counts from the end, gathers at half the speed
@wp.func_native("""
    wp::vec_t<16, float> seen;
    const float* grey = (const float*)others.data;
    for (int l = 0; l < 16; ++l) {
        const int column = (int)u[l], row = (int)v[l], i = first + row * pitch + column;
        const float right = u[l] - (float)column, down = v[l] - (float)row;
        const float above = grey[i] + right * (grey[i + 1] - grey[i]);
        const float below = grey[i + pitch] + right * (grey[i + pitch + 1] - grey[i + pitch]);
        seen[l] = above + down * (below - above);
    }
    return seen;
""")
def between_pixels(others: wp.array3d[float], first: int, pitch: int, u: lanes, v: lanes) -> lanes:
    """What the picture whose first pixel is `first`, with rows of `pitch`, has at columns u and rows v, neither of which are negative."""
    ...


@wp.kernel
def look(
    others: wp.array3d[float], motion: wp.array3d[float], step: wp.array2d[float], near: wp.array3d[float], chunk: int,
    shown: wp.array3d[lanes],
    stretch: int, first: int,
):  # fmt: skip
    """What others show on a chunk's planes before a picture: shown `[O, h, w]`; an item is a part of a row.

    others: `[O, h + 3, w + 3]`, within a border of 0, a pixel to the left and above, two to the right and below; step: inverse depth
    `[h, w]` from plane to plane; near `[2, h, w]`: the first and the last plane that matter to any square with the pixel in it.
    """
    h = shown.shape[1]
    w = shown.shape[2]
    row, left, right = part_of_row(first + wp.tid(), stretch, w)
    o = row / h
    y = row % h
    number = numbers(chunk)
    for x in range(left, right):
        if matters(near, y, x, chunk):
            inverse_depths = number * step[y, x]
            parts = wp.cw_div(lanes(1.0), greater_of(on_axis(motion, o, 2, x, y, inverse_depths), lanes(BEHIND)))
            u = lanes(1.0) + wp.cw_mul(on_axis(motion, o, 0, x, y, inverse_depths), parts)
            v = lanes(1.0) + wp.cw_mul(on_axis(motion, o, 1, x, y, inverse_depths), parts)
            u = lesser_of(greater_of(u, lanes(0.0)), lanes(float(w + 1)))
            v = lesser_of(greater_of(v, lanes(0.0)), lanes(float(h + 1)))
            shown[o, y, x] = between_pixels(others, o * others.shape[1] * others.shape[2], others.shape[2], u, v)


@wp.struct
class Prices:
    """What planes cost that are not compared, or compared and cannot be."""

    unseen: float  # where no other picture shows them
    outside: float  # more, beyond the bounds
    pinned: float  # more, two planes or more from a known point


@cache
def squares_of(half: int) -> tuple[wp.Function, wp.Function]:
    """What squares of 2 half + 1 pixels are compared by: sums over a column of one, and the correlation that its columns' sums give. Their
    sides are unrolled, since a sum that goes round a loop is no vector."""

    @wp.func
    def of_column(own: wp.array3d[float], shown: wp.array3d[lanes], o: int, y: int, x: int):
        """Of what another shows, of its square, and of its product with `own`."""
        s = lanes(0.0)
        squares = lanes(0.0)
        products = lanes(0.0)
        for k in range(wp.static(-half), wp.static(half + 1)):
            r = wp.clamp(y + k, 0, own.shape[1] - 1)
            v = shown[o, r, x]
            s = s + v
            squares = squares + wp.cw_mul(v, v)
            products = products + v * own[0, r, x]
        return s, squares, products

    @wp.func
    def correlation(own: wp.array3d[float], sums: wp.array3d[lanes], i: int, first: int, y: int, x: int, noise: float):
        """Of the square around a pixel, whose first column's sums are `first` of item i's."""
        s = lanes(0.0)
        squares = lanes(0.0)
        products = lanes(0.0)
        for k in range(wp.static(2 * half + 1)):
            s = s + sums[i, first + k, 0]
            squares = squares + sums[i, first + k, 1]
            products = products + sums[i, first + k, 2]
        part = wp.static(1 / (2 * half + 1) ** 2)
        mean = s * part
        spread = roots(greater_of(squares * part - wp.cw_mul(mean, mean), lanes(0.0)) + lanes(noise * noise))
        return wp.cw_div(products * part - mean * own[1, y, x], spread * own[2, y, x])

    return of_column, correlation


@cache
def compare_kernel(half: int) -> wp.Kernel:
    """For squares of 2 half + 1 pixels."""
    of_column, correlation = squares_of(half)

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def compare(
        own: wp.array3d[float], shown: wp.array3d[lanes], motion: wp.array3d[float], step: wp.array2d[float],
        bounds: wp.array3d[float], near: wp.array3d[float], known: wp.array2d[float], chunk: int, noise: float, prices: Prices,
        sums: wp.array3d[lanes], cost: wp.array3d[lanes],
        stretch: int, first: int,
    ):  # fmt: skip
        """What a chunk's planes cost, cost `[h, w, CHUNKS]`: 1 - correlation with `shown`, as `look` leaves it, the mean of the better half
        of the others (they may not see the place), and `prices`. An item is a part of a row.

        own `[3, h, w]`: grey levels, and their means and standard deviations in the squares, with noise; bounds `[2, h, w]`: the first and
        the last plane that matter, NaN where none does and none costs more; near: as of `look`; known `[h, w]`: inverse depths, NaN where
        not known; sums `[items, stretch + 2 half, 4]`: to work in.
        """
        i = first + wp.tid()
        h = cost.shape[0]
        w = cost.shape[1]
        y, left, right = part_of_row(i, stretch, w)
        number = numbers(chunk)
        for x in range(left, right):
            cost[y, x, chunk] = lanes(2.0)
            sums[i, x - left, 3] = lanes(2.0)
        for o in range(shown.shape[0]):
            for column in range(left - half, right + half):
                x = wp.clamp(column, 0, w - 1)
                if matters(near, y, x, chunk):
                    s, squares, products = of_column(own, shown, o, y, x)
                    sums[i, column - left + half, 0] = s
                    sums[i, column - left + half, 1] = squares
                    sums[i, column - left + half, 2] = products
            for x in range(left, right):
                if matters(bounds, y, x, chunk):
                    alike = correlation(own, sums, i, x - left, y, x, noise)
                    inverse_depths = number * step[y, x]
                    z = on_axis(motion, o, 2, x, y, inverse_depths)
                    u = on_axis(motion, o, 0, x, y, inverse_depths) + 0.5 * z
                    v = on_axis(motion, o, 1, x, y, inverse_depths) + 0.5 * z
                    within = lesser_of(lesser_of(u, z * float(w) - u), lesser_of(v, z * float(h) - v))
                    within = lesser_of(within, z - inverse_depths * NEAREST)
                    now = lanes(prices.unseen) + cut(-within, 0.0, lanes(1.0 - prices.unseen) - alike)
                    best = cost[y, x, chunk]
                    sums[i, x - left, 3] = lesser_of(sums[i, x - left, 3], greater_of(now, best))
                    cost[y, x, chunk] = lesser_of(now, best)
        for x in range(left, right):
            now = lanes(prices.unseen)
            if matters(bounds, y, x, chunk):
                now = cost[y, x, chunk]
                if shown.shape[0] > 2:
                    now = 0.5 * (now + sums[i, x - left, 3])
            beyond = lanes(prices.outside)
            now = now + cut(number, bounds[0, y, x], beyond) + cut(-number, -bounds[1, y, x], beyond)
            if known[y, x] >= 0.0:
                away = number - lanes(known[y, x] / greater(step[y, x], 1.0e-9))
                now = now + prices.pinned * lesser_of(0.5 * greater_of(away, -away), lanes(1.0))
            cost[y, x, chunk] = now

    return compare


@wp.kernel
def choose(
    cost: wp.array3d[float], total: wp.array3d[lanes], step: wp.array2d[float], bounds: wp.array3d[float], lowest: wp.array2d[float],
    unseen: float, least: wp.array2d[float], inverse_depth: wp.array2d[float],
    stretch: int, first: int,
):  # fmt: skip
    """Of planes that cost `total` `[h, w, CHUNKS]` the best: what it costs, infinite where none matters; and the inverse depth between it
    and its neighbours, by a parabola, NaN where no other picture shows it, as `cost` says, or it is not beyond plane `lowest`."""
    begin, end = pixels_of(first + wp.tid(), stretch, total.shape[0], total.shape[1])
    for pixel in range(begin, end):
        y, x = pixel_of(pixel, total.shape[1])
        here = smallest(total[y, x, 0])
        k = int(0)
        for other in range(1, CHUNKS):
            there = smallest(total[y, x, other])
            if there < here:
                here = there
                k = other
        lane = int(0)
        while total[y, x, k][lane] > here:
            lane += 1
        best = TILE * k + lane
        between = float(best)
        if best > 0 and best < PLANES - 1:
            before = total[y, x, (best - 1) / TILE][(best - 1) % TILE]
            after = total[y, x, (best + 1) / TILE][(best + 1) % TILE]
            between += wp.clamp(0.5 * (before - after) / greater(before + after - 2.0 * here, 1.0e-6), -0.5, 0.5)
        least[y, x] = wp.where(bounds[1, y, x] >= 0.0, here, wp.inf)
        seen = cost[y, x, best] != unseen and between > lowest[y, x]
        inverse_depth[y, x] = wp.where(seen, between * step[y, x], wp.nan)
