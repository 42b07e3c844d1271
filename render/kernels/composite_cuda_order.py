"""Compositing for CUDA in each pixel's own order of depth: a block takes tiles, a thread one pixel of each.

A pixel goes through its tile's list again and again, and each time keeps the nearest HELD of the entries that lie behind what it has drawn:
depth peeling by batches, exact for any number of entries, without memory of its own. Most pixels are done after a few rounds, since hardly
any light passes. Keys are as on the CPU (`ray_rows.py`): a place as a whole number, then the entry. Where a tile is settled (`settled.py`)
the list's own places are the keys, and a round begins where the one before it ended.

Backward peels from the back and leaves each entry's weight and derivative at each pixel in memory of the block's, a segment of the list at
a time; then the block sums them up by groups of entries, as in the tiles' order.
"""

from functools import cache

import warp as wp

from render.kernels.block_sums import channel_sums, gradient_sums
from render.kernels.pixel_sight import OPTIONS, pixel_functions, pixel_layers, pixel_of, pixel_unlayering, warp_of
from render.kernels.ray_rows import LEAST
from render.kernels.types import OPACITY, Wanted, Window, Z
from render.kernels.warps import ballot, record_of

HELD = wp.constant(16)
MOST_SPLATS = 1 << 25
"""Splats of a picture: no tile's list may be longer than its entries' numbers in a key."""
ENTRIES = wp.constant(wp.int64(MOST_SPLATS))
STEPS = wp.constant(wp.float64(1 << 37))  # of a place from 0 to 1; with the entry's number they fill 62 bits
FIRST = wp.constant(wp.int64(-(1 << 63) + 1))  # before all keys

vec_keys = wp.types.vector(length=HELD, dtype=wp.int64)
vec_fades = wp.types.vector(length=HELD, dtype=wp.float32)


@wp.func
def entry_of(key: wp.int64):
    return int(key & (ENTRIES - wp.int64(1)))


@cache
def next_entries(ray: bool, eyes: bool):
    """The function that finds a pixel's next HELD entries, front to back or (way = -1) back to front."""
    canonical, faded, _ = pixel_functions(ray, eyes)

    @wp.func
    def find(
        begin: int, beyond: wp.int64, way: int, start: int, count: int, settled: int, far: wp.float64, x: float, y: float,
        ids: wp.array[int], records: wp.array2d[float], frames: wp.array2d[wp.float64], rays: wp.array4d[wp.float64],
    ):  # fmt: skip
        """The least of the keys times `way` that are more than `beyond`, rising, with exp(-s) of each; how many; and how much of the list
        was gone through."""
        keys = vec_keys()
        fades = vec_fades()
        held = int(0)
        k = int(begin)
        while k < count:
            n = wp.where(way > 0, k, count - 1 - k)
            i = ids[start + n]
            e = faded(record_of(records, i), frames, rays, i, x, y)
            if e > 0.0:
                place = wp.int64(0)
                if settled == 0:
                    u, q = canonical(frames, rays, i, x, y)
                    along = wp.dot(u, q)
                    place = wp.int64(wp.rint(STEPS * (along / (wp.abs(along) + wp.max(wp.dot(u, u), LEAST) * far))))
                key = wp.int64(way) * (place * ENTRIES + wp.int64(n))
                if key > beyond and (held < HELD or key < keys[HELD - 1]):
                    m = int(wp.min(held, HELD - 1))
                    while m > 0:
                        if keys[m - 1] < key:
                            break
                        keys[m] = keys[m - 1]
                        fades[m] = fades[m - 1]
                        m -= 1
                    keys[m] = key
                    fades[m] = e
                    held = wp.min(held + 1, HELD)
            k += 1
            if settled != 0 and held == HELD:
                break
        return keys, fades, held, k

    return find


@wp.func
def amid(tile_starts: wp.array[int], tile: int, ids: wp.array[int], records: wp.array2d[float]):
    """The depth about which places are told apart best."""
    start = tile_starts[tile]
    stop = tile_starts[tile + 1]
    far = wp.float64(1.0)
    if stop > start:
        far = wp.float64(records[ids[(start + stop) // 2], Z])
    return far


@cache
def order_blocks(wanted: Wanted, ray: bool, eyes: bool, tile_size: int):
    """The forward kernel; arguments as of `composite_blocks`."""
    pixel = pixel_of(tile_size)
    begin, lay, write = pixel_layers(wanted)
    _, _, depth = pixel_functions(ray, eyes)
    find = next_entries(ray, eyes)

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def order_blocks_forward(
        tile_starts: wp.array[int], ids: wp.array[int], records: wp.array2d[float], frames: wp.array2d[wp.float64],
        rays: wp.array4d[wp.float64], slopes: wp.array[wp.vec2], features: wp.array2d[float], channels: int,
        window: Window, alpha_max: float, termination: float,
        planes: wp.array3d[float], picks: wp.array3d[float], settled: wp.array[int], last: wp.array2d[wp.int64],
    ):  # fmt: skip
        """settled: 1 for tiles whose list's order is every pixel's; last: the key of each pixel's last entry."""
        tile, thread = wp.tid()
        px, py, x, y = pixel(window, tile, thread)
        p = begin(channels, planes, px, py)
        start = tile_starts[tile]
        count = tile_starts[tile + 1] - start
        far = amid(tile_starts, tile, ids, records)
        drawn = wp.int64(FIRST)
        held = int(HELD)
        k = int(0)
        while held == HELD and p.t >= termination:
            keys, fades, held, k = find(k, drawn, 1, start, count, settled[tile], far, x, y, ids, records, frames, rays)
            for m in range(held):
                if p.t < termination:
                    break
                i = ids[start + entry_of(keys[m])]
                r = record_of(records, i)
                far_off = float(0.0)
                if wp.static(wanted.depths):
                    far_off = depth(r, slopes, frames, rays, i, x, y)
                p = lay(p, r, i, wp.min(r[OPACITY] * fades[m], alpha_max), far_off, features, channels, planes, px, py)
                drawn = keys[m]
            if settled[tile] == 0:
                k = int(0)
        write(p, planes, picks, px, py)
        last[py, px] = drawn

    return order_blocks_forward


@cache
def order_blocks_gradient(wanted: Wanted, ray: bool, eyes: bool, tile_size: int):
    """The backward kernel; arguments as of `composite_blocks_gradient`, `blocks` blocks in all."""
    pixel = pixel_of(tile_size)
    behind, take_off = pixel_unlayering(wanted)
    _, _, depth = pixel_functions(ray, eyes)
    lanes, _, _ = warp_of(tile_size)
    lay_down, write = gradient_sums(wanted, ray, eyes, tile_size)
    write_channels = channel_sums(wanted)
    find = next_entries(ray, eyes)

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def order_blocks_backward(
        tile_starts: wp.array[int], ids: wp.array[int], slot_of: wp.array[int], records: wp.array2d[float],
        frames: wp.array2d[wp.float64], rays: wp.array4d[wp.float64], slopes: wp.array[wp.vec2],
        features: wp.array2d[float], channels: int, window: Window, alpha_max: float,
        planes: wp.array3d[float], grads: wp.array3d[float], settled: wp.array[int], last: wp.array2d[wp.int64],
        blocks: int, pushes: wp.array3d[wp.vec2],
        slots: wp.array2d[float], channel_slots: wp.array2d[float], frame_slots: wp.array2d[float], g_rays: wp.array4d[wp.float64],
    ):  # fmt: skip
        """pushes `[blocks, entries of a segment, threads]`: an entry's weight and derivative at each pixel of the tile at hand."""
        block, thread = wp.tid()
        segment = pushes.shape[1]
        for tile in range(block, window.tiles_x * window.tiles_y, blocks):
            px, py, x, y = pixel(window, tile, thread)
            start = tile_starts[tile]
            count = tile_starts[tile + 1] - start
            far = amid(tile_starts, tile, ids, records)
            for first in range(0, count, segment):
                here = wp.min(count - first, segment)
                for n in range(here):
                    pushes[block, n, thread] = wp.vec2(0.0)
                b = behind(planes, grads, px, py)
                beyond = -last[py, px] - wp.int64(1)
                held = int(HELD)
                k = int(0)
                while held == HELD:
                    keys, fades, held, k = find(k, beyond, -1, start, count, settled[tile], far, x, y, ids, records, frames, rays)
                    for m in range(held):
                        n = entry_of(-keys[m])
                        i = ids[start + n]
                        r = record_of(records, i)
                        far_off = float(0.0)
                        if wp.static(wanted.depth):
                            far_off = depth(r, slopes, frames, rays, i, x, y)
                        b = take_off(b, r, i, fades[m], alpha_max, far_off, features, channels, grads, px, py)
                        if n >= first and n < first + segment:
                            pushes[block, n - first, thread] = wp.vec2(b.w, b.de)
                        beyond = keys[m]
                    if settled[tile] == 0:
                        k = int(0)
                for group in range(0, here, wp.static(lanes)):
                    entries = wp.min(here - group, wp.static(lanes))
                    seen = int(0)
                    for entry in range(entries):
                        push = pushes[block, group + entry, thread]
                        if ballot(push[0] != 0.0 or push[1] != 0.0) != 0:
                            seen = seen | (1 << entry)
                            i = ids[start + first + group + entry]
                            b.w = push[0]
                            b.de = push[1]
                            lay_down(entry, i, record_of(records, i), thread, x, y, b, frames, rays, g_rays)
                    at = start + first + group
                    write(seen, at, at + entries, thread, slot_of, slots, frame_slots)
                    if wp.static(wanted.channels):
                        for entry in range(entries):
                            push = pushes[block, group + entry, thread]
                            write_channels(push[0], slot_of[at + entry], thread, px, py, channels, grads, channel_slots)

    return order_blocks_backward
