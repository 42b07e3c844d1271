"""The backward pass's sums over a block's threads: an entry's gradient at each pixel of a tile becomes the entry's slot.

A block takes a tile's entries LANES at a time. Each warp lays down the sums over its own pixels of those entries that show there, then the
block waits, adds the warps' sums up and writes the slots. No atomics and one order of adding: the same bits every time.
"""

from functools import cache

import warp as wp

from render.kernels.canonical import CENTRE, GROUP
from render.kernels.pixel_sight import FRAME_GRADIENTS, Behind, frame_of, from_ridge, pixel_functions, ray_at, warp_of
from render.kernels.ray_rows import LEAST
from render.kernels.types import (
    G_ALONG,
    G_BLUE,
    G_DOWN,
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
    OPACITY,
    H,
    K,
    M,
    Wanted,
    X,
    Y,
)
from render.kernels.warps import SUMS, WARPS, shared_floats, shared_ints, sum_of_warp, vec_record, vec_sums, wait_for_block


@cache
def gradient_sums(wanted: Wanted, ray: bool, eyes: bool, tile_size: int):
    """`lay_down`, which all threads of a warp call for an entry that at least one of them sees, and `write`, which all threads of a block
    call after every group of entries, with those of the group that their warp laid down as bits."""
    canonical, _, _ = pixel_functions(ray, eyes)
    lanes, _, _ = warp_of(tile_size)
    warps = WARPS if tile_size > 1 else 1
    kinds = 2 if ray else 1
    of_kind = warps * lanes * SUMS
    cell = shared_floats(kinds * of_kind)
    laid = shared_ints(warps)

    @wp.func
    def keep(kind: int, thread: int, entry: int, values: vec_sums):
        warp = thread // wp.static(lanes)
        at = kind * wp.static(of_kind) + (warp * wp.static(lanes) + entry) * wp.static(SUMS)
        if wp.static(lanes > 1):
            lane = thread % wp.static(lanes)
            total = sum_of_warp(values)
            if lane < wp.static(SUMS):
                cell(at + lane, total, True)
        else:
            for k in range(wp.static(SUMS)):
                cell(at + k, values[k], True)

    @wp.func
    def lay_down(
        entry: int, i: int, r: vec_record, thread: int, x: float, y: float, b: Behind,
        frames: wp.array2d[wp.float64], rays: wp.array4d[wp.float64], g_rays: wp.array4d[wp.float64],
    ):  # fmt: skip
        """entry: its number in the group; b: of this pixel, from which the splat was taken off."""
        ds = -r[OPACITY] * b.de
        sums = vec_sums()
        sums[G_OPACITY] = b.de
        sums[G_RED] = b.w * b.g[0]
        sums[G_GREEN] = b.w * b.g[1]
        sums[G_BLUE] = b.w * b.g[2]
        if wp.static(ray):
            # s is least at t, so dt changes nothing: ds/dq = m, ds/du = -t m, with q = A (p - o), u = A d
            u, q = canonical(frames, rays, i, x, y)
            inverse = wp.float64(1.0) / wp.max(wp.dot(u, u), LEAST)
            t = wp.dot(u, q) * inverse
            m = wp.float64(ds) * (q - t * u)
            turned = wp.transpose(frame_of(frames, i))
            pushed = turned * m
            group = int(0)
            missed = wp.vec3d(frames[i, CENTRE], frames[i, CENTRE + 1], frames[i, CENTRE + 2])
            if wp.static(eyes):
                group = int(frames[i, GROUP])
                missed = missed - ray_at(rays, group, 3, x, y)
            d = ray_at(rays, group, 0, x, y)
            # depth is t itself: dt/dq = u / |u|^2, dt/du = (q - 2 t u) / |u|^2
            by_q = wp.vec3d()
            by_u = wp.vec3d()
            if wp.static(wanted.depth):
                g_far = wp.float64(b.w * b.g_z) * inverse
                by_q = g_far * u
                by_u = g_far * (q - wp.float64(2.0) * t * u)
            of_frame_by_depth = wp.outer(by_q, missed) + wp.outer(by_u, d)
            missed = missed - t * d
            along = turned * by_u - t * pushed
            pushed = pushed + turned * by_q
            row = int(y)
            column = int(x)
            of_frame = vec_sums()
            for c in range(3):
                for k in range(3):
                    of_frame[3 * k + c] = float(m[k] * missed[c] + of_frame_by_depth[k, c])
                of_frame[CENTRE + c] = float(pushed[c])
                if b.w != 0.0 and row < rays.shape[2] and column < rays.shape[3]:  # a pixel's rays are its thread's alone
                    g_rays[group, c, row, column] = g_rays[group, c, row, column] + along[c]
                    if wp.static(eyes):
                        g_rays[group, 3 + c, row, column] = g_rays[group, 3 + c, row, column] - pushed[c]
            keep(1, thread, entry, of_frame)
        else:
            k2 = r[K] * r[K]
            offset, dy = from_ridge(r, x, y)
            sums[G_X] = -2.0 * k2 * offset * ds
            sums[G_Y] = (2.0 * k2 * r[M] * offset - 2.0 * r[H] * dy) * ds
            sums[G_K] = 2.0 * r[K] * offset * offset * ds
            sums[G_M] = -2.0 * k2 * offset * dy * ds
            sums[G_H] = dy * dy * ds
            if wp.static(wanted.depth):
                g_far = b.w * b.g_z
                sums[G_Z] = g_far
                sums[G_ALONG] = g_far * (x - r[X])
                sums[G_DOWN] = g_far * (y - r[Y])
        keep(0, thread, entry, sums)

    @wp.func
    def total(kind: int, entry: int, at: int):
        out = float(0.0)
        for warp in range(wp.static(warps)):
            if (laid(warp, 0, False) >> entry) & 1 != 0:
                out += cell(kind * wp.static(of_kind) + (warp * wp.static(lanes) + entry) * wp.static(SUMS) + at, 0.0, False)
        return out

    @wp.func
    def write(
        bits: int, first: int, stop: int, thread: int, slot_of: wp.array[int], slots: wp.array2d[float], frame_slots: wp.array2d[float]
    ):
        """The slots of the entries from `first` to before `stop`, a group at most; those that no warp laid down become 0."""
        if thread % wp.static(lanes) == 0:
            laid(thread // wp.static(lanes), bits, True)
        wait_for_block()
        for k in range(thread, wp.static(lanes * SUMS), wp.static(tile_size * tile_size)):
            entry = k // wp.static(SUMS)
            at = k % wp.static(SUMS)
            if first + entry < stop:
                if at < wp.static(GRADIENTS):
                    slots[slot_of[first + entry], at] = total(0, entry, at)
                if wp.static(ray):  # noqa: SIM102 - a static branch and a dynamic one
                    if at < wp.static(FRAME_GRADIENTS):
                        frame_slots[slot_of[first + entry], at] = total(1, entry, at)
        wait_for_block()

    return lay_down, write


@cache
def channel_sums(wanted: Wanted):
    """The function that sums an entry's gradients by channel over the block, and writes them; all threads must call it."""

    @wp.func
    def write_channels(
        w: float, slot: int, thread: int, px: int, py: int, channels: int, grads: wp.array3d[float], channel_slots: wp.array2d[float]
    ):
        for c in range(channels):
            # reading a tile's sum is a barrier of the whole block: it must not stand where only some threads come by
            of_channel = wp.tile_sum(wp.tile(w * grads[wp.static(wanted.first_channel) + c, py, px]))[0]
            if thread == 0:
                channel_slots[slot, c] = of_channel

    return write_channels
