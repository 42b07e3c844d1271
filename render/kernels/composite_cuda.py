"""Compositing for CUDA in the tiles' order: a block takes a tile, a thread one of its pixels.

Each warp goes through the tile's entries by itself, a group of LANES at a time: first each of its threads asks whether one of them reaches
the warp's patch of pixels, then all go through those that do. In backward the block adds up a group's gradients together
(`block_sums.py`): no atomics, so the same bits every time.
"""

from functools import cache

import warp as wp

from render.kernels.block_sums import channel_sums, gradient_sums
from render.kernels.pixel_sight import OPTIONS, patch_meets, pixel_functions, pixel_layers, pixel_of, pixel_unlayering, warp_of
from render.kernels.types import OPACITY, Wanted, Window
from render.kernels.warps import LANES, ballot, highest_bit, largest_of_warp, lowest_bit, of_lane, record_of

vec_shares = wp.types.vector(length=LANES, dtype=wp.float32)


@cache
def reached_of(tile_size: int):
    """The function by which a warp's threads look for the entries of a group that reach its patch: one each."""
    lanes, _, _ = warp_of(tile_size)
    pixel, meets = pixel_of(tile_size), patch_meets(tile_size)

    @wp.func
    def reached(first: int, stop: int, window: Window, tile: int, thread: int, ids: wp.array[int], records: wp.array2d[float]):
        """The splat of the thread's entry, and which of the group's entries, up to before `stop`, reach the patch, as bits."""
        n = first + thread % wp.static(lanes)
        i = int(0)
        yes = bool(False)
        if n < stop:
            i = ids[n]
            _px, _py, x, y = pixel(window, tile, thread // wp.static(lanes) * wp.static(lanes))
            yes = meets(record_of(records, i), x, y)
        return i, ballot(yes)

    return reached


@cache
def composite_blocks(wanted: Wanted, ray: bool, eyes: bool, tile_size: int):
    """The forward kernel for response "ray" or "conic" and tiles of `tile_size` pixels square. eyes: as of `ray_functions`."""
    lanes, _, _ = warp_of(tile_size)
    pixel, reached = pixel_of(tile_size), reached_of(tile_size)
    _, faded, depth = pixel_functions(ray, eyes)
    begin, lay, write = pixel_layers(wanted)

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def composite_blocks_forward(
        tile_starts: wp.array[int], ids: wp.array[int], records: wp.array2d[float], frames: wp.array2d[wp.float64],
        rays: wp.array4d[wp.float64], slopes: wp.array[wp.vec2], features: wp.array2d[float], channels: int,
        window: Window, alpha_max: float, termination: float,
        planes: wp.array3d[float], picks: wp.array3d[float], last: wp.array2d[int],
    ):  # fmt: skip
        """frames and rays are not read where the response is "conic"; last: one past each pixel's last entry."""
        tile, thread = wp.tid()
        px, py, x, y = pixel(window, tile, thread)
        p = begin(channels, planes, px, py)
        first = tile_starts[tile]
        stop = tile_starts[tile + 1]
        end = int(first)
        while first < stop and ballot(p.t >= termination) != 0:
            mine, here = reached(first, stop, window, tile, thread, ids, records)
            while here != 0:
                entry = lowest_bit(here)
                here = here & (here - 1)
                i = of_lane(mine, entry)
                if p.t >= termination:
                    r = record_of(records, i)
                    e = faded(r, frames, rays, i, x, y)
                    if e > 0.0:
                        far = float(0.0)
                        if wp.static(wanted.depths):
                            far = depth(r, slopes, frames, rays, i, x, y)
                        p = lay(p, r, i, wp.min(r[OPACITY] * e, alpha_max), far, features, channels, planes, px, py)
                        end = first + entry + 1
            first += wp.static(lanes)
        write(p, planes, picks, px, py)
        last[py, px] = end

    return composite_blocks_forward


@cache
def composite_blocks_gradient(wanted: Wanted, ray: bool, eyes: bool, tile_size: int):
    """The backward kernel; planes and grads as of `composite_gradient`, per pixel instead of per row."""
    lanes, _, _ = warp_of(tile_size)
    pixel, reached = pixel_of(tile_size), reached_of(tile_size)
    _, faded, depth = pixel_functions(ray, eyes)
    behind, take_off = pixel_unlayering(wanted)
    lay_down, write = gradient_sums(wanted, ray, eyes, tile_size)
    write_channels = channel_sums(wanted)

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def composite_blocks_backward(
        tile_starts: wp.array[int], ids: wp.array[int], slot_of: wp.array[int], records: wp.array2d[float],
        frames: wp.array2d[wp.float64], rays: wp.array4d[wp.float64], slopes: wp.array[wp.vec2],
        features: wp.array2d[float], channels: int, window: Window, alpha_max: float,
        planes: wp.array3d[float], grads: wp.array3d[float], last: wp.array2d[int],
        slots: wp.array2d[float], channel_slots: wp.array2d[float], frame_slots: wp.array2d[float], g_rays: wp.array4d[wp.float64],
    ):  # fmt: skip
        """frame_slots and g_rays `[G, C, H, W]` of the image, zeroed before, are not written where the response is "conic"."""
        tile, thread = wp.tid()
        px, py, x, y = pixel(window, tile, thread)
        start = tile_starts[tile]
        stop = tile_starts[tile + 1]
        b = behind(planes, grads, px, py)
        end = last[py, px]
        end_of_warp = largest_of_warp(end)
        groups = (stop - start + wp.static(lanes - 1)) // wp.static(lanes)
        for back in range(groups):
            first = start + (groups - 1 - back) * wp.static(lanes)
            mine, here = reached(first, wp.min(stop, end_of_warp), window, tile, thread, ids, records)
            seen = int(0)
            shares = vec_shares()
            while here != 0:
                entry = highest_bit(here)
                bit = 1 << entry
                here = here ^ bit
                i = of_lane(mine, entry)
                r = record_of(records, i)
                e = float(0.0)
                if first + entry < end:
                    e = faded(r, frames, rays, i, x, y)
                if ballot(e > 0.0) != 0:
                    b.w = 0.0
                    b.de = 0.0
                    if e > 0.0:
                        far = float(0.0)
                        if wp.static(wanted.depth):
                            far = depth(r, slopes, frames, rays, i, x, y)
                        b = take_off(b, r, i, e, alpha_max, far, features, channels, grads, px, py)
                    seen = seen | bit
                    lay_down(entry, i, r, thread, x, y, b, frames, rays, g_rays)
                    if wp.static(wanted.channels):
                        shares[entry] = b.w
            write(seen, first, stop, thread, slot_of, slots, frame_slots)
            if wp.static(wanted.channels):
                for entry in range(wp.min(stop - first, wp.static(lanes))):
                    write_channels(shares[entry], slot_of[first + entry], thread, px, py, channels, grads, channel_slots)

    return composite_blocks_backward
