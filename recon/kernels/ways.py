"""How alike pictures look where what they show may have gone from one to the next. A lane vector is 16 ways that it may have gone, each at
a distance of its own, at one pixel, as the planes of `planes.py`."""

from functools import cache

import warp as wp

from recon.kernels.planes import BEHIND, between_pixels, part_of_row, squares_of
from render.kernels.lanewise import cut, greater_of, lesser_of
from render.kernels.types import OPTIONS, lanes

wp.set_module_options(OPTIONS)

DEAR = wp.constant(9.0)
"""More than any way costs."""


@wp.struct
class Others:
    """Where other pictures show a picture's pixels: at `turns` `[O, 3, 3]` of (column, row, 1) and `closer` `[h, w]` times `gone`
    `[O, 3, chunks]`, as column, row and 1, times how far before them; `size`: their columns and rows. They may show what is before them by
    more than `closer` times `nearest` `[chunks]`. Those of one of the `sides` `[O]` stand together."""

    turns: wp.array3d[float]
    gone: wp.array3d[lanes]
    closer: wp.array2d[float]
    nearest: wp.array[lanes]
    sides: wp.array[int]
    size: wp.vec2


@wp.func
def on_axis(others: Others, o: int, axis: int, x: int, y: int, chunk: int):
    base = others.turns[o, axis, 0] * float(x) + others.turns[o, axis, 1] * float(y) + others.turns[o, axis, 2]
    return lanes(base) + others.closer[y, x] * others.gone[o, axis, chunk]


@wp.kernel
def look_along(greys: wp.array3d[float], others: Others, chunk: int, shown: wp.array3d[lanes], stretch: int, first: int):
    """What others show where a chunk's ways take a picture's pixels: shown `[O, h, w]`; an item is a part of a row. greys:
    `[O, H + 3, W + 3]`, within a border of 0, a pixel to the left and above, two to the right and below."""
    row, left, right = part_of_row(first + wp.tid(), stretch, shown.shape[2])
    o = row / shown.shape[1]
    y = row % shown.shape[1]
    for x in range(left, right):
        parts = wp.cw_div(lanes(1.0), greater_of(on_axis(others, o, 2, x, y, chunk), lanes(BEHIND)))
        u = lanes(1.0) + wp.cw_mul(on_axis(others, o, 0, x, y, chunk), parts)
        v = lanes(1.0) + wp.cw_mul(on_axis(others, o, 1, x, y, chunk), parts)
        u = lesser_of(greater_of(u, lanes(0.0)), lanes(others.size[0] + 1.0))
        v = lesser_of(greater_of(v, lanes(0.0)), lanes(others.size[1] + 1.0))
        shown[o, y, x] = between_pixels(greys, o * greys.shape[1] * greys.shape[2], greys.shape[2], u, v)


@cache
def unlike_kernel(half: int) -> wp.Kernel:
    """For squares of 2 half + 1 pixels."""
    of_column, correlation = squares_of(half)

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def unlike_along(
        own: wp.array3d[float], shown: wp.array3d[lanes], others: Others, chunk: int, noise: float, unseen: float,
        sums: wp.array3d[lanes], cost: wp.array2d[lanes],
        stretch: int, first: int,
    ):  # fmt: skip
        """What a chunk's ways cost, `[h, w]`: 1 - correlation with `shown`, as `look_along` leaves it, in the mean of a side's others that
        may show it, `unseen` where none does, and of the better side. An item is a part of a row.

        own `[3, h, w]`: grey levels, and their means and standard deviations in the squares, with noise; sums
        `[items, stretch + 2 half, 5]`: to work in.
        """
        i = first + wp.tid()
        w = cost.shape[1]
        y, left, right = part_of_row(i, stretch, w)
        for x in range(left, right):
            cost[y, x] = lanes(DEAR)
        for o in range(shown.shape[0]):
            if o == 0 or others.sides[o] != others.sides[wp.max(o - 1, 0)]:
                for x in range(left, right):
                    sums[i, x - left, 3] = lanes(0.0)
                    sums[i, x - left, 4] = lanes(0.0)
            for column in range(left - half, right + half):
                x = wp.clamp(column, 0, w - 1)
                s, squares, products = of_column(own, shown, o, y, x)
                sums[i, column - left + half, 0] = s
                sums[i, column - left + half, 1] = squares
                sums[i, column - left + half, 2] = products
            last = o + 1 == shown.shape[0] or others.sides[o] != others.sides[wp.min(o + 1, shown.shape[0] - 1)]
            for x in range(left, right):
                alike = correlation(own, sums, i, x - left, y, x, noise)
                z = on_axis(others, o, 2, x, y, chunk)
                u = on_axis(others, o, 0, x, y, chunk) + 0.5 * z
                v = on_axis(others, o, 1, x, y, chunk) + 0.5 * z
                within = lesser_of(lesser_of(u, z * others.size[0] - u), lesser_of(v, z * others.size[1] - v))
                within = lesser_of(within, z - others.closer[y, x] * others.nearest[chunk])
                costs = sums[i, x - left, 3] + cut(-within, 0.0, lanes(1.0) - alike)
                count = sums[i, x - left, 4] + cut(-within, 0.0, lanes(1.0))
                if last:
                    now = wp.cw_div(costs, greater_of(count, lanes(1.0))) + unseen * cut(count, 0.5, lanes(1.0))
                    cost[y, x] = lesser_of(cost[y, x], now)
                else:
                    sums[i, x - left, 3] = costs
                    sums[i, x - left, 4] = count

    return unlike_along
