"""What a row of pixels sees along its own rays: splats in their canonical frames, and the row's list of entries.

A splat in the canonical frame where it is the unit Gaussian: M = S^-1 R' of the camera, q = M p for its centre p (`FRAME` floats). There a
ray with direction d from the eye is u = M d, and (3DGUT, Wu et al. 2025; StopThePop, Radl et al. 2024)

    s = |u x q|^2 / (2 |u|^2)   is the least exponent along the ray,   t = (u . q) / |u|^2   the place of it, in the ray's own lengths.
"""

from functools import cache

import warp as wp

from render.kernels.lanewise import below, cut
from render.kernels.rows import exp_of, row_range
from render.kernels.types import OPACITY, RAY_BOUNDS, S_MAX, TILE, TINY, H, K, M, X, Y, lanes

KEY, ALPHA, OWNER, THROUGH, PART_W, PART_E = (wp.constant(i) for i in range(6))
"""Lists of a row: where along the ray, alpha, which entry, the light that reaches it; then by entry: its weight, dL/da times e^-s."""
LISTS = 6


@wp.struct
class Rays:
    """Directions of a row's pixels."""

    x: lanes
    y: lanes
    z: lanes


@wp.struct
class Canonical:
    """A row's rays in the frame of a splat: u, |u|^2, u x q."""

    x: lanes
    y: lanes
    z: lanes
    square: lanes
    cx: lanes
    cy: lanes
    cz: lanes


@wp.func
def rays_of(rays: wp.array3d[lanes], row: int, tx: int):
    d = Rays()
    d.x = rays[0, row, tx]
    d.y = rays[1, row, tx]
    d.z = rays[2, row, tx]
    return d


@wp.func
def along(frames: wp.array2d[float], i: int, row: int, d: Rays):
    """One component of M d."""
    return d.x * frames[i, 3 * row] + d.y * frames[i, 3 * row + 1] + d.z * frames[i, 3 * row + 2]


@wp.func
def canonical(frames: wp.array2d[float], i: int, d: Rays):
    c = Canonical()
    c.x = along(frames, i, 0, d)
    c.y = along(frames, i, 1, d)
    c.z = along(frames, i, 2, d)
    qx = frames[i, 9]
    qy = frames[i, 10]
    qz = frames[i, 11]
    c.square = wp.max(wp.cw_mul(c.x, c.x) + wp.cw_mul(c.y, c.y) + wp.cw_mul(c.z, c.z), lanes(TINY))
    c.cx = c.y * qz - c.z * qy
    c.cy = c.z * qx - c.x * qz
    c.cz = c.x * qy - c.y * qx
    return c


@wp.func
def place(frames: wp.array2d[float], i: int, c: Canonical):
    """t: where along the rays the splat is greatest."""
    return wp.cw_div(c.x * frames[i, 9] + c.y * frames[i, 10] + c.z * frames[i, 11], c.square)


@wp.func
def insert(lists: wp.array3d[lanes], band: int, count: int, key: lanes, alpha: lanes, owner: float):
    """Add an entry to a row's list of `count`, sorted by key, equal keys in the order in which they come."""
    lists[band, KEY, count] = key
    lists[band, ALPHA, count] = alpha
    lists[band, OWNER, count] = lanes(owner)
    k = int(count)
    while k > 0:
        front = lists[band, KEY, k - 1]
        back = lists[band, KEY, k]
        swap = wp.min(wp.max((front - back) * 1.0e30, lanes(0.0)), lanes(1.0))
        if wp.max(swap) <= 0.0:
            break
        stay = lanes(1.0) - swap
        lists[band, KEY, k - 1] = wp.min(front, back)
        lists[band, KEY, k] = wp.max(front, back)
        a = lists[band, ALPHA, k - 1]
        b = lists[band, ALPHA, k]
        lists[band, ALPHA, k - 1] = wp.cw_mul(stay, a) + wp.cw_mul(swap, b)
        lists[band, ALPHA, k] = wp.cw_mul(stay, b) + wp.cw_mul(swap, a)
        c = lists[band, OWNER, k - 1]
        d = lists[band, OWNER, k]
        lists[band, OWNER, k - 1] = wp.cw_mul(stay, c) + wp.cw_mul(swap, d)
        lists[band, OWNER, k] = wp.cw_mul(stay, d) + wp.cw_mul(swap, c)
        k -= 1


@cache
def ray_functions(ray: bool, squarings: int):
    """exp(-s) within the cutoff of a row's pixels, 0 beyond it, by the conic or along the rays."""
    exp_minus = exp_of(squarings)

    @wp.func
    def faded(records: wp.array[lanes], frames: wp.array2d[float], i: int, d: Rays, column: lanes, x0: float, y: float):
        record = records[i]
        s_max = record[S_MAX] * wp.static(1.0 / RAY_BOUNDS if ray else 1.0)
        s = lanes(0.0)
        if wp.static(ray):
            c = canonical(frames, i, d)
            s = wp.cw_div(wp.cw_mul(c.cx, c.cx) + wp.cw_mul(c.cy, c.cy) + wp.cw_mul(c.cz, c.cz), c.square) * 0.5
            # what the ray leaves behind it is not seen
            s = s + below(0.0, place(frames, i, c)) * (2.0 * s_max)
        else:
            k = record[K]
            dy = y - record[Y]
            u = column * k - lanes(k * (record[X] - x0 + record[M] * dy))
            s = wp.cw_mul(u, u) + lanes(record[H] * dy * dy)
        return cut(s, s_max, exp_minus(s))

    return faded


@cache
def list_row(ray: bool, ordered: bool, squarings: int):
    """Makes a row's list; returns how many entries it has."""
    faded = ray_functions(ray, squarings)

    @wp.func
    def make(
        ids: wp.array[int], start: int, stop: int, records: wp.array[lanes], frames: wp.array2d[float], reach: wp.array3d[int],
        d: Rays, column: lanes, x0: float, y: float, r: int, band: int, alpha_max: float, termination: float, lists: wp.array3d[lanes],
    ):  # fmt: skip
        count = int(0)
        through = lanes(1.0)
        for n in range(start, stop):
            if reach[band, 0, n - start] <= r and reach[band, 1, n - start] >= r:
                i = ids[n]
                record = records[i]
                a = wp.min(faded(records, frames, i, d, column, x0, y) * record[OPACITY], lanes(alpha_max))
                if wp.max(a) > 0.0:
                    if wp.static(ordered):
                        insert(lists, band, count, place(frames, i, canonical(frames, i, d)), a, float(n - start))
                    else:
                        lists[band, ALPHA, count] = a
                        lists[band, OWNER, count] = lanes(float(n - start))
                        through = wp.cw_mul(through, lanes(1.0) - a)
                    count += 1
                    if wp.static(not ordered):  # noqa: SIM102 - a static branch and a dynamic one
                        if wp.max(through) < termination:
                            break
        return count

    return make


@wp.func
def reach_of(records: wp.array[lanes], ids: wp.array[int], start: int, stop: int, x0: float, y0: float, band: int, reach: wp.array3d[int]):
    """First and last row of each of the tile's entries."""
    for n in range(start, stop):
        rows = row_range(records[ids[n]], x0, y0)
        reach[band, 0, n - start] = rows[0]
        reach[band, 1, n - start] = rows[1]


@wp.func
def field_of(records: wp.array[lanes], ids: wp.array[int], start: int, owners: lanes, field: int):
    """A field of each lane's own entry."""
    value = records[ids[start + int(owners[0])]][field]
    out = lanes(value)
    if wp.min(owners) < wp.max(owners):
        for j in range(TILE):
            out[j] = records[ids[start + int(owners[j])]][field]
    return out


@wp.func
def channel_of(features: wp.array2d[float], ids: wp.array[int], start: int, owners: lanes, c: int):
    """A channel of each lane's own entry."""
    value = features[ids[start + int(owners[0])], c]
    out = lanes(value)
    if wp.min(owners) < wp.max(owners):
        for j in range(TILE):
            out[j] = features[ids[start + int(owners[j])], c]
    return out
