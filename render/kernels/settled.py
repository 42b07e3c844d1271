"""Tiles in which no two splats can change places: there each pixel's own order is the tile's.

Over a tile's rays, box by box of their directions and where they begin, interval arithmetic bounds t = (u . q) / |u|^2 (`ray_rows.py`) of
every entry from both sides. Where each begins no nearer than all before it end, their order is the same on every ray: so it is proven, up
to float64's rounding, without looking at a pixel. Splats that face the camera, walls, and what stands apart pass; leaves do not.
"""

import warp as wp

from render.kernels.canonical import GROUP, MOVED
from render.kernels.types import OPTIONS, Window

wp.set_module_options(OPTIONS)

NONE = wp.constant(wp.float64(0.0))
NEVER = wp.constant(wp.float64(1.0e300))


@wp.func
def corner(bounds: wp.array4d[wp.float64], group: int, part: int, row: int, column: int):
    """Middle or half of the extent of a tile's directions (part 0) or of where they begin (part 3)."""
    return wp.vec3d(bounds[group, part, row, column], bounds[group, part + 1, row, column], bounds[group, part + 2, row, column])


@wp.func
def places(frames: wp.array2d[wp.float64], i: int, d: wp.vec3d, d_half: wp.vec3d, o: wp.vec3d, o_half: wp.vec3d):
    """Least and greatest t of the splat on any ray of a box."""
    top = wp.float64(NONE)
    slack = wp.float64(NONE)
    least = wp.float64(NONE)
    most = wp.float64(NONE)
    for k in range(3):
        a = wp.vec3d(frames[i, 3 * k], frames[i, 3 * k + 1], frames[i, 3 * k + 2])
        wide = wp.vec3d(wp.abs(a[0]), wp.abs(a[1]), wp.abs(a[2]))
        u = wp.dot(a, d)
        u_half = wp.dot(wide, d_half)
        q = frames[i, MOVED + k] - wp.dot(a, o)
        q_half = wp.dot(wide, o_half)
        top += u * q
        slack += u_half * (wp.abs(q) + q_half) + wp.abs(u) * q_half
        inner = wp.max(wp.abs(u) - u_half, NONE)
        outer = wp.abs(u) + u_half
        least += inner * inner
        most += outer * outer
    low = top - slack
    high = top + slack
    if least <= NONE:
        return wp.vec2d(-NEVER, NEVER)
    if low > NONE:
        return wp.vec2d(low / most, high / least)
    if high < NONE:
        return wp.vec2d(low / least, high / most)
    return wp.vec2d(low / least, high / least)


@wp.kernel
def settle(
    tile_starts: wp.array[int], ids: wp.array[int], frames: wp.array2d[wp.float64],
    middles: wp.array4d[wp.float64], halves: wp.array4d[wp.float64], eyes: int, window: Window, settled: wp.array[int],
    first: int,
):  # fmt: skip
    """settled: 1 for tiles of the window in which the list's order is proven to be that of every ray; middles, halves
    `[G, C, tiles_y, tiles_x]` of the image: of the extent of each tile's rays."""
    tile = first + wp.tid()
    row = window.top + tile // window.tiles_x
    column = window.left + tile % window.tiles_x
    out = int(1)
    front = wp.float64(-NEVER)
    group = int(-1)
    d = wp.vec3d()
    d_half = wp.vec3d()
    o = wp.vec3d()
    o_half = wp.vec3d()
    for n in range(tile_starts[tile], tile_starts[tile + 1]):
        i = ids[n]
        mine = int(frames[i, GROUP])
        if mine != group:
            group = int(mine)
            d = corner(middles, group, 0, row, column)
            d_half = corner(halves, group, 0, row, column)
            if eyes != 0:
                o = corner(middles, group, 3, row, column)
                o_half = corner(halves, group, 3, row, column)
        reach = places(frames, i, d, d_half, o, o_half)
        if reach[0] < front:
            out = int(0)
            break
        front = reach[1]
    settled[tile] = out
