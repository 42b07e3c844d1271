"""Compositing for CUDA in the tiles' order: a block takes a tile, a thread one of its pixels.

The block walks its tile's entries together, by conic or along each pixel's ray. In backward it sums every entry's gradient over its pixels
with a tile reduction, and one thread writes the slot: no atomics, so the same bits every time.
"""

from functools import cache

import warp as wp

from render.kernels.pixel_sight import OPTIONS, Behind, gradient_sums, pixel_functions, pixel_layers, pixel_of, pixel_unlayering
from render.kernels.types import OPACITY, Wanted, Window


@cache
def composite_blocks(wanted: Wanted, ray: bool, eyes: bool, tile_size: int):
    """The forward kernel for response "ray" or "conic" and tiles of `tile_size` pixels square. eyes: as of `ray_functions`."""
    pixel = pixel_of(tile_size)
    _, faded = pixel_functions(ray, eyes)
    begin, lay, write = pixel_layers(wanted)

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def composite_blocks_forward(
        tile_starts: wp.array[int], ids: wp.array[int], records: wp.array2d[float], frames: wp.array2d[wp.float64],
        rays: wp.array4d[wp.float64], features: wp.array2d[float], channels: int, window: Window, alpha_max: float, termination: float,
        planes: wp.array3d[float], picks: wp.array3d[float], last: wp.array2d[int],
    ):  # fmt: skip
        """frames and rays are not read where the response is "conic"; last: one past each pixel's last entry."""
        tile, thread = wp.tid()
        px, py, x, y = pixel(window, tile, thread)
        p = begin(channels, planes, px, py)
        stop = tile_starts[tile]
        for n in range(tile_starts[tile], tile_starts[tile + 1]):
            if p.t < termination:
                break
            i = ids[n]
            e = faded(records, frames, rays, i, x, y)
            if e > 0.0:
                p = lay(p, i, wp.min(records[i, OPACITY] * e, alpha_max), records, features, channels, planes, px, py)
                stop = n + 1
        write(p, planes, picks, px, py)
        last[py, px] = stop

    return composite_blocks_forward


@cache
def composite_blocks_gradient(wanted: Wanted, ray: bool, eyes: bool, tile_size: int):
    """The backward kernel; planes and grads as of `composite_gradient`, per pixel instead of per row."""
    pixel = pixel_of(tile_size)
    _, faded = pixel_functions(ray, eyes)
    take_off = pixel_unlayering(wanted)
    add_up = gradient_sums(wanted, ray, eyes)

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def composite_blocks_backward(
        tile_starts: wp.array[int], ids: wp.array[int], slot_of: wp.array[int], records: wp.array2d[float],
        frames: wp.array2d[wp.float64], rays: wp.array4d[wp.float64], features: wp.array2d[float], channels: int, window: Window,
        alpha_max: float, planes: wp.array3d[float], grads: wp.array3d[float], last: wp.array2d[int],
        slots: wp.array2d[float], channel_slots: wp.array2d[float], frame_slots: wp.array2d[float], g_rays: wp.array4d[wp.float64],
    ):  # fmt: skip
        """frame_slots and g_rays `[G, C, H, W]` of the image, zeroed before, are not written where the response is "conic"."""
        tile, thread = wp.tid()
        px, py, x, y = pixel(window, tile, thread)
        start = tile_starts[tile]
        count = tile_starts[tile + 1] - start
        b = Behind()
        b.t = planes[0, py, px]
        b.rest = grads[0, py, px]
        stop = last[py, px]
        for back in range(count):
            n = start + count - 1 - back
            i = ids[n]
            e = float(0.0)
            if n < stop:
                e = faded(records, frames, rays, i, x, y)
            b.w = 0.0
            b.de = 0.0
            if e > 0.0:
                b = take_off(b, i, e, alpha_max, records, features, channels, grads, px, py)
            add_up(
                i, slot_of[n], thread, x, y, px, py, b.w, b.de,
                records, frames, rays, channels, grads, slots, channel_slots, frame_slots, g_rays,
            )  # fmt: skip

    return composite_blocks_backward
