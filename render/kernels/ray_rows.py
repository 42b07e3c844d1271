"""What a row of pixels sees along its own rays: splats in their canonical frames, and the row's list of entries, in float64.

A splat in the canonical frame where it is the unit Gaussian: A = S^-1 R' and its centre p (`FRAME`). There a ray from o along d is
u = A d, and the centre lies at q = A (p - o) from where it begins (3DGUT, Wu et al. 2025; StopThePop, Radl et al. 2024):

    t = (u . q) / |u|^2   is the place along the ray where the splat is greatest, in the ray's own lengths,
    m = q - t u           what the ray misses its centre by,   s = |m|^2 / 2   the least exponent.

In float32 m cancels, and two places that differ by a millionth of a depth are one; so all of it is float64. To sort, a place and the
number of its entry become one whole number, so that minimum and maximum move both, and equal places keep the list's order.
"""

from functools import cache

import warp as wp

from render.kernels.canonical import GROUP, MOVED
from render.kernels.lanewise import below, cut
from render.kernels.rows import depth_along, exp_of, from_corner, row_range
from render.kernels.types import FARTHEST, OPACITY, S_MAX, TILE, X_REST, Y_REST, H, K, M, X, Y, Z, lanes

lanes64 = wp.types.vector(length=TILE, dtype=wp.float64)

ALPHA, WEIGHT, PICKED, SHADE, THROUGH = (wp.constant(i) for i in range(5))
"""Lists of a row. By entry: its alpha, its weight, whether it is the median (backward: dL/d alpha), the gradient of its colour; by place in
the order: the light that reaches it."""
LISTS = 5

NONE = wp.constant(wp.float64(0.0))
LEAST = wp.constant(wp.float64(1.0e-200))
KEYS = wp.constant(wp.float64(2251799813685248.0))
"""2^51: keys are whole numbers up to it, which float64 holds."""
WHOLE = wp.constant(wp.float64(6755399441055744.0))
"""1.5 * 2^52: adding it rounds to a whole number."""


@wp.func
def along(frames: wp.array2d[wp.float64], i: int, row: int, x: lanes64, y: lanes64, z: lanes64):
    """One component of A times a row of vectors."""
    return x * frames[i, 3 * row] + y * frames[i, 3 * row + 1] + z * frames[i, 3 * row + 2]


@wp.func
def dot(ax: lanes64, ay: lanes64, az: lanes64, bx: lanes64, by: lanes64, bz: lanes64):
    return wp.cw_mul(ax, bx) + wp.cw_mul(ay, by) + wp.cw_mul(az, bz)


@wp.func
def square(x: lanes64, y: lanes64, z: lanes64):
    return wp.max(dot(x, y, z, x, y, z), lanes64(LEAST))


@wp.func
def share(along: lanes64, square: lanes64, far: wp.float64):
    """t = along / square as a number from -1 to 1 that rises with it; far: a length, about which places are told apart best."""
    return wp.cw_div(along, wp.max(along, -along) + square * far)


@wp.func
def entry(keys: wp.array[wp.float64], place: int, lane: int, entries: int):
    """Which entry of the list stands at a place of a lane's order."""
    return int(wp.int64(keys[place * TILE + lane])) & (entries - 1)


# All lanes at once, by Batcher's merge exchange (Knuth, TAOCP 5.2.2 M), which takes as many steps for any order. Native, since wp.min and
# wp.max mind NaN, which takes five times the instructions.
@wp.func_native("""
    typedef double row __attribute__((vector_size(128), aligned(8)));
    row *all = (row *)keys.data + first;
    for (int p = 1; p < count; p *= 2)
        for (int k = p; k > 0; k /= 2)
            for (int j = k % p; j + k < count; j += 2 * k)
                for (int i = j, end = j + 2 * k < count ? j + k : count - k; i < end; ++i)
                    if ((i ^ (i + k)) < 2 * p) {
                        row a = all[i], b = all[i + k];
                        all[i] = a < b ? a : b;
                        all[i + k] = a < b ? b : a;
                    }
""")
def sort(keys: wp.array[wp.float64], first: int, count: int): ...  # type: ignore[empty-body]


# How much of a list the light reaches in any order. Where it has gone out in the list's own, those behind are left out as soon as what is
# nearer than all of them, on every lane, lets through less than `termination`: with them or without, no pixel changes by more than that.
# Looked at 8 entries further on, then 16, 32, and so on.
@wp.func_native("""
    typedef double row __attribute__((vector_size(128), aligned(8)));
    typedef float seen __attribute__((vector_size(64), aligned(4)));
    typedef int choice __attribute__((vector_size(64)));
    const row *all = (const row *)keys.data + first;
    const seen *alpha = (const seen *)lists.data + alphas;
    seen light = {};
    light += 1.0f;
    int dark = 0;
    for (; dark < count; ++dark) {
        if ((dark & 7) == 0 && !__builtin_reduce_or(light >= termination)) break;
        light *= 1.0f - alpha[dark];
    }
    int looks = 0, ends[24];
    for (int step = 8; looks < 24 && dark + step < count; step *= 2) ends[looks++] = dark + step;
    row nearest = {}, before[24];
    nearest += 1.0e300;
    for (int i = count - 1, look = looks - 1; look >= 0; --i) {
        row key = __builtin_convertvector(alpha[i] > 0, row) != 0 ? all[i] : nearest;
        nearest = key < nearest ? key : nearest;
        if (i == ends[look]) before[look--] = nearest;
    }
    for (int look = 0; look < looks; ++look) {
        light = light * 0.0f + 1.0f;
        for (int i = 0; i < ends[look]; ++i) {
            choice sure = __builtin_convertvector(all[i] < before[look], choice);
            light *= sure ? 1.0f - alpha[i] : light * 0.0f + 1.0f;
        }
        if (!__builtin_reduce_or(light >= termination)) return ends[look];
    }
    return count;
""")
def lit(keys: wp.array[wp.float64], first: int, count: int, lists: wp.array3d[lanes], alphas: int, termination: float) -> int: ...  # type: ignore[empty-body]


@wp.func
def reach_of(records: wp.array[lanes], ids: wp.array[int], start: int, stop: int, x0: float, y0: float, band: int, reach: wp.array3d[int]):
    """First and last row of each of the tile's entries."""
    for n in range(start, stop):
        rows = row_range(records[ids[n]], x0, y0)
        reach[band, 0, n - start] = rows[0]
        reach[band, 1, n - start] = rows[1]


@cache
def ray_functions(ray: bool, eyes: bool, squarings: int):
    """How a row of pixels looks at a splat: `canonical`, its rays in the splat's frame, u and q, `faded`, exp(-s) within the cutoff and 0
    beyond it, by the conic or along the rays, and `depth`. eyes: rays begin in places of their own, and each instance may have rays of its
    own."""
    exp_minus = exp_of(squarings)

    @wp.func
    def canonical(frames: wp.array2d[wp.float64], i: int, rays: wp.array4d[lanes64], row: int, tx: int):
        group = int(0)
        qx = lanes64(frames[i, MOVED])
        qy = lanes64(frames[i, MOVED + 1])
        qz = lanes64(frames[i, MOVED + 2])
        if wp.static(eyes):
            group = int(frames[i, GROUP])
            ox = rays[group, 3, row, tx]
            oy = rays[group, 4, row, tx]
            oz = rays[group, 5, row, tx]
            qx = qx - along(frames, i, 0, ox, oy, oz)
            qy = qy - along(frames, i, 1, ox, oy, oz)
            qz = qz - along(frames, i, 2, ox, oy, oz)
        x = rays[group, 0, row, tx]
        y = rays[group, 1, row, tx]
        z = rays[group, 2, row, tx]
        return along(frames, i, 0, x, y, z), along(frames, i, 1, x, y, z), along(frames, i, 2, x, y, z), qx, qy, qz

    @wp.func
    def faded_conic(record: lanes, column: lanes, x0: float, y: float):
        k = record[K]
        dy = (y - record[Y]) - record[Y_REST]
        u = column * k - lanes(k * ((record[X] - x0) + record[X_REST] + record[M] * dy))
        s = wp.cw_mul(u, u) + lanes(record[H] * dy * dy)
        return cut(s, record[S_MAX], exp_minus(s))

    @wp.func
    def faded_along(record: lanes, column: lanes, x0: float, ux: lanes64, uy: lanes64, uz: lanes64, qx: lanes64, qy: lanes64, qz: lanes64):
        s_max = record[S_MAX]
        along_ray = dot(ux, uy, uz, qx, qy, qz)
        t = wp.cw_div(along_ray, square(ux, uy, uz))
        mx = qx - wp.cw_mul(t, ux)
        my = qy - wp.cw_mul(t, uy)
        mz = qz - wp.cw_mul(t, uz)
        s = lanes(dot(mx, my, mz, mx, my, mz) * wp.float64(0.5))
        # what the ray leaves behind it is not seen, nor anything where there is no ray
        s = s + (lanes(1.0) - below(0.0, lanes(-along_ray))) * (2.0 * s_max)
        # nor on the other side of an image that closes on itself, where its copy stands
        beside = column - lanes(record[X] - x0)
        s = s + (lanes(1.0) - below(0.0, wp.cw_mul(beside, beside) - lanes(record[X_REST] * record[X_REST]))) * (2.0 * s_max)
        return cut(s, s_max, exp_minus(s))

    @wp.func
    def depth(
        record: lanes, slopes: wp.array[wp.vec2], frames: wp.array2d[wp.float64], i: int, rays: wp.array4d[lanes64],
        column: lanes, x0: float, y0: float, row: int, tx: int, r: int,
    ):  # fmt: skip
        """Where a row's pixels meet the splat; of no meaning where they do not."""
        if wp.static(ray):
            ux, uy, uz, qx, qy, qz = canonical(frames, i, rays, row, tx)
            t = wp.cw_div(dot(ux, uy, uz, qx, qy, qz), square(ux, uy, uz))
            return lanes(wp.min(wp.max(t, lanes64(NONE)), lanes64(wp.float64(FARTHEST))))
        return depth_along(from_corner(slopes[i], record, x0, y0), column, r)

    return canonical, faded_conic, faded_along, depth


@cache
def list_row(ray: bool, eyes: bool, ordered: bool, squarings: int):
    """Makes a row's list: which of the tile's entries, their alphas, and, where pixels want another order than the tile's, their sorted
    keys. Returns how many entries, and whether they are sorted by key."""
    canonical, faded_conic, faded_along, _ = ray_functions(ray, eyes, squarings)

    @wp.func
    def make(
        ids: wp.array[int], start: int, stop: int, records: wp.array[lanes], frames: wp.array2d[wp.float64], reach: wp.array3d[int],
        rays: wp.array4d[lanes64], column: lanes, x0: float, y: float, row: int, tx: int, r: int, band: int,
        alpha_max: float, termination: float, entries: int, first_key: int,
        lists: wp.array3d[lanes], keys: wp.array[lanes64], keys_by_lane: wp.array[wp.float64],
    ):  # fmt: skip
        """entries: a power of two, at least how many the tile has: a key is its place, in as many steps as that leaves, then its entry."""
        count = int(0)
        through = lanes(1.0)
        farthest = lanes(-9.0)  # place of those that show
        disorder = lanes(-9.0)
        steps = KEYS / wp.float64(entries)
        far = wp.float64(1.0)
        if stop > start:
            amid = records[ids[(start + stop) // 2]]
            far = wp.float64(amid[Z])
        for n in range(start, stop):
            if reach[band, 0, n - start] <= r and reach[band, 1, n - start] >= r:
                i = ids[n]
                record = records[i]
                a = lanes(0.0)
                at = lanes64(NONE)
                if wp.static(ray or ordered):
                    ux, uy, uz, qx, qy, qz = canonical(frames, i, rays, row, tx)
                    if wp.static(ordered):
                        at = share(dot(ux, uy, uz, qx, qy, qz), square(ux, uy, uz), far)
                if wp.static(ray):
                    a = wp.min(faded_along(record, column, x0, ux, uy, uz, qx, qy, qz) * record[OPACITY], lanes(alpha_max))
                else:
                    a = wp.min(faded_conic(record, column, x0, y) * record[OPACITY], lanes(alpha_max))
                reach[band, 2, count] = n - start
                lists[band, ALPHA, count] = a
                if wp.static(ordered):
                    whole = (at * steps + lanes64(WHOLE)) - lanes64(WHOLE)
                    keys[first_key + count] = whole * wp.float64(entries) + lanes64(wp.float64(count))
                    hidden = (lanes(1.0) - wp.min(a * 1.0e30, lanes(1.0))) * 4.0
                    disorder = wp.max(disorder, farthest - lanes(at) - hidden)
                    farthest = wp.max(farthest, lanes(at) - hidden)
                    count += 1
                else:
                    count += 1
                    through = wp.cw_mul(through, lanes(1.0) - a)
                    if (count & 7) == 0:  # noqa: SIM102 - looking costs more than drawing one
                        if wp.max(through) < termination:
                            break
        crossing = bool(False)
        if wp.static(ordered):  # noqa: SIM102 - a static branch and a dynamic one
            if wp.max(disorder) >= 0.0:
                count = lit(keys_by_lane, first_key, count, lists, (band * lists.shape[1] + ALPHA) * lists.shape[2], termination)
                sort(keys_by_lane, first_key, count)
                crossing = True
        return count, crossing

    return make
