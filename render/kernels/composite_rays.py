"""Compositing ray by ray, for the CPU: the response of the 3D Gaussian along each pixel's ray, and each pixel's own order of depth.

Response "ray" takes the least exponent along the ray for the conic's; order "pixel" sorts by its place (`ray_rows.py`). A row of a tile
makes a list of the entries that reach it, one lane vector an entry. Sorted, the list is kept by insertion, all lanes at once: entries
come by the depth of their centres, which is nearly each ray's own order, so few places are passed. Backward makes the same list, goes
through it from its end, and leaves each lane's part with the entry that it came from; then every entry sums up its row.
"""

from functools import cache

import warp as wp

from render.kernels.lanewise import below
from render.kernels.ray_rows import (
    ALPHA,
    OWNER,
    PART_E,
    PART_W,
    THROUGH,
    canonical,
    channel_of,
    field_of,
    list_row,
    ray_functions,
    rays_of,
    reach_of,
)
from render.kernels.rows import ROLLED
from render.kernels.types import (
    BLUE,
    FRAME,
    G_BLUE,
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
    GREEN,
    INSTANCE,
    MEDIAN,
    OPACITY,
    RED,
    TILE,
    WHO,
    H,
    K,
    M,
    Wanted,
    Window,
    X,
    Y,
    Z,
    lanes,
)


@cache
def composite_rays(wanted: Wanted, ray: bool, ordered: bool, squarings: int):
    """The forward kernel, for response "ray" or "conic", in each pixel's own order or the tiles'."""
    make = list_row(ray, ordered, squarings)

    @wp.kernel(module="unique", module_options=ROLLED, enable_backward=False)
    def composite_rays_forward(
        tile_starts: wp.array[int], ids: wp.array[int], records: wp.array[lanes], frames: wp.array2d[float],
        features: wp.array2d[float], channels: int, rays: wp.array3d[lanes],
        window: Window, bands: int, alpha_max: float, termination: float,
        columns: wp.array[lanes], lists: wp.array3d[lanes], reach: wp.array3d[int],
        planes: wp.array3d[lanes], picks: wp.array3d[lanes],
        first: int,
    ):  # fmt: skip
        """lists `[bands, LISTS, longest tile list]`, reach `[bands, 2, longest]`: working memory."""
        band = first + wp.tid()
        column = columns[0]
        tiles = window.tiles_x * window.tiles_y
        for tile in range(band * tiles // bands, (band + 1) * tiles // bands):
            tx = tile % window.tiles_x
            row0 = (tile // window.tiles_x) * TILE
            x0 = float((window.left + tx) * TILE) + 0.5
            y0 = float((window.top + tile // window.tiles_x) * TILE) + 0.5
            start = tile_starts[tile]
            stop = tile_starts[tile + 1]
            reach_of(records, ids, start, stop, x0, y0, band, reach)
            for r in range(TILE):
                row = row0 + r
                d = rays_of(rays, row, tx)
                count = make(ids, start, stop, records, frames, reach, d, column, x0, y0 + float(r), r, band, alpha_max, termination, lists)
                t = lanes(1.0)
                red = lanes(0.0)
                green = lanes(0.0)
                blue = lanes(0.0)
                z = lanes(0.0)
                weights = lanes(0.0)
                median = lanes(0.0)
                who = lanes(-1.0)
                most = lanes(0.0)
                if wp.static(wanted.channels):
                    for c in range(channels):
                        planes[wp.static(wanted.first_channel) + c, row, tx] = lanes(0.0)
                for k in range(count):
                    if wp.max(t) < termination:
                        break
                    owners = lists[band, OWNER, k]
                    w = wp.cw_mul(t, lists[band, ALPHA, k])
                    red = red + wp.cw_mul(w, field_of(records, ids, start, owners, RED))
                    green = green + wp.cw_mul(w, field_of(records, ids, start, owners, GREEN))
                    blue = blue + wp.cw_mul(w, field_of(records, ids, start, owners, BLUE))
                    if wp.static(wanted.depth):
                        z = z + wp.cw_mul(w, field_of(records, ids, start, owners, Z))
                        weights = weights + w
                    if wp.static(wanted.channels):
                        for c in range(channels):
                            p = wp.static(wanted.first_channel) + c
                            planes[p, row, tx] = planes[p, row, tx] + wp.cw_mul(w, channel_of(features, ids, start, owners, c))
                    if wp.static(wanted.median):
                        here = wp.cw_mul(below(0.5, t - w), lanes(1.0) - below(0.5, t))
                        median = median + wp.cw_mul(here, field_of(records, ids, start, owners, Z))
                    if wp.static(wanted.instance):
                        leads = wp.min(wp.max((w - most) * 1.0e30, lanes(0.0)), lanes(1.0))
                        who = who + wp.cw_mul(leads, field_of(records, ids, start, owners, INSTANCE) - who)
                        most = wp.max(most, w)
                    t = t - w
                planes[0, row, tx] = t
                planes[1, row, tx] = red
                planes[2, row, tx] = green
                planes[3, row, tx] = blue
                if wp.static(wanted.depth):
                    planes[4, row, tx] = z
                    planes[5, row, tx] = weights
                if wp.static(wanted.median):
                    picks[MEDIAN, row, tx] = median
                if wp.static(wanted.instance):
                    picks[WHO, row, tx] = who

    return composite_rays_forward


@cache
def composite_rays_gradient(wanted: Wanted, ray: bool, ordered: bool, squarings: int):
    """The backward kernel: writes every entry's gradient slot, those of its channels and of its canonical frame, and the rays' gradient."""
    make = list_row(ray, ordered, squarings)
    faded = ray_functions(ray, squarings)

    @wp.kernel(module="unique", module_options=ROLLED, enable_backward=False)
    def composite_rays_backward(
        tile_starts: wp.array[int], ids: wp.array[int], slot_of: wp.array[int], records: wp.array[lanes], frames: wp.array2d[float],
        features: wp.array2d[float], channels: int, rays: wp.array3d[lanes],
        window: Window, bands: int, alpha_max: float, termination: float,
        columns: wp.array[lanes], lists: wp.array3d[lanes], reach: wp.array3d[int], scattered: wp.array4d[float],
        planes: wp.array3d[lanes], grads: wp.array3d[lanes],
        slots: wp.array2d[float], channel_slots: wp.array2d[float], frame_slots: wp.array2d[float], g_rays: wp.array3d[lanes],
        first: int,
    ):  # fmt: skip
        """scattered: the same memory as lists, by lane. grads: as for `composite_gradient`."""
        band = first + wp.tid()
        column = columns[0]
        one = lanes(1.0)
        tiles = window.tiles_x * window.tiles_y
        for tile in range(band * tiles // bands, (band + 1) * tiles // bands):
            tx = tile % window.tiles_x
            row0 = (tile // window.tiles_x) * TILE
            x0 = float((window.left + tx) * TILE) + 0.5
            y0 = float((window.top + tile // window.tiles_x) * TILE) + 0.5
            start = tile_starts[tile]
            stop = tile_starts[tile + 1]
            reach_of(records, ids, start, stop, x0, y0, band, reach)
            for n in range(start, stop):
                for c in range(GRADIENTS):
                    slots[slot_of[n], c] = 0.0
                if wp.static(wanted.channels):
                    for c in range(channels):
                        channel_slots[slot_of[n], c] = 0.0
                if wp.static(ray):
                    for c in range(FRAME):
                        frame_slots[slot_of[n], c] = 0.0
            for r in range(TILE):
                row = row0 + r
                y = y0 + float(r)
                d = rays_of(rays, row, tx)
                count = make(ids, start, stop, records, frames, reach, d, column, x0, y, r, band, alpha_max, termination, lists)
                t = lanes(1.0)
                seen = int(0)
                for k in range(count):
                    if wp.max(t) < termination:
                        break
                    lists[band, THROUGH, k] = t
                    t = t - wp.cw_mul(t, lists[band, ALPHA, k])
                    seen += 1
                for n in range(stop - start):
                    if reach[band, 0, n] <= r and reach[band, 1, n] >= r:
                        lists[band, PART_W, n] = lanes(0.0)
                        lists[band, PART_E, n] = lanes(0.0)
                gr = grads[1, row, tx]
                gg = grads[2, row, tx]
                gb = grads[3, row, tx]
                rest = grads[0, row, tx] * 1.0
                for back in range(seen):
                    k = seen - 1 - back
                    owners = lists[band, OWNER, k]
                    a = lists[band, ALPHA, k]
                    through = lists[band, THROUGH, k]
                    w = wp.cw_mul(through, a)
                    dot = wp.cw_mul(gr, field_of(records, ids, start, owners, RED))
                    dot = dot + wp.cw_mul(gg, field_of(records, ids, start, owners, GREEN))
                    dot = dot + wp.cw_mul(gb, field_of(records, ids, start, owners, BLUE))
                    if wp.static(wanted.depth):
                        dot = dot + wp.cw_mul(grads[4, row, tx], field_of(records, ids, start, owners, Z)) + grads[5, row, tx]
                    if wp.static(wanted.channels):
                        for c in range(channels):
                            g_c = grads[wp.static(wanted.first_channel) + c, row, tx]
                            dot = dot + wp.cw_mul(g_c, channel_of(features, ids, start, owners, c))
                    da = wp.cw_mul(through, dot) - wp.cw_div(rest, one - a)
                    rest = rest + wp.cw_mul(w, dot)
                    for j in range(TILE):
                        scattered[band, PART_W, int(owners[j]), j] = w[j]
                        scattered[band, PART_E, int(owners[j]), j] = da[j]
                ray_x = lanes(0.0)
                ray_y = lanes(0.0)
                ray_z = lanes(0.0)
                for n in range(stop - start):
                    if reach[band, 0, n] <= r and reach[band, 1, n] >= r:
                        w = lists[band, PART_W, n]
                        da = lists[band, PART_E, n]
                        i = ids[start + n]
                        slot = slot_of[start + n]
                        record = records[i]
                        opacity = record[OPACITY]
                        e = faded(records, frames, i, d, column, x0, y)
                        de = wp.cw_mul(wp.cw_mul(da, e), below(alpha_max, e * opacity))
                        slots[slot, G_OPACITY] = slots[slot, G_OPACITY] + wp.dot(de, one)
                        slots[slot, G_RED] = slots[slot, G_RED] + wp.dot(w, gr)
                        slots[slot, G_GREEN] = slots[slot, G_GREEN] + wp.dot(w, gg)
                        slots[slot, G_BLUE] = slots[slot, G_BLUE] + wp.dot(w, gb)
                        if wp.static(wanted.depth):
                            slots[slot, G_Z] = slots[slot, G_Z] + wp.dot(w, grads[4, row, tx])
                        if wp.static(wanted.channels):
                            for c in range(channels):
                                g_c = grads[wp.static(wanted.first_channel) + c, row, tx]
                                channel_slots[slot, c] = channel_slots[slot, c] + wp.dot(w, g_c)
                        ds = de * (-opacity)
                        if wp.static(ray):
                            v = canonical(frames, i, d)
                            qx = frames[i, 9]
                            qy = frames[i, 10]
                            qz = frames[i, 11]
                            per = wp.cw_div(ds, v.square)
                            hx = wp.cw_mul(per, v.cx)  # dL/d (u x q)
                            hy = wp.cw_mul(per, v.cy)
                            hz = wp.cw_mul(per, v.cz)
                            far = wp.cw_mul(v.cx, v.cx) + wp.cw_mul(v.cy, v.cy) + wp.cw_mul(v.cz, v.cz)
                            far = wp.cw_mul(wp.cw_div(far, v.square), per)
                            ux = hz * qy - hy * qz - wp.cw_mul(far, v.x)
                            uy = hx * qz - hz * qx - wp.cw_mul(far, v.y)
                            uz = hy * qx - hx * qy - wp.cw_mul(far, v.z)
                            frame_slots[slot, 0] = frame_slots[slot, 0] + wp.dot(ux, d.x)
                            frame_slots[slot, 1] = frame_slots[slot, 1] + wp.dot(ux, d.y)
                            frame_slots[slot, 2] = frame_slots[slot, 2] + wp.dot(ux, d.z)
                            frame_slots[slot, 3] = frame_slots[slot, 3] + wp.dot(uy, d.x)
                            frame_slots[slot, 4] = frame_slots[slot, 4] + wp.dot(uy, d.y)
                            frame_slots[slot, 5] = frame_slots[slot, 5] + wp.dot(uy, d.z)
                            frame_slots[slot, 6] = frame_slots[slot, 6] + wp.dot(uz, d.x)
                            frame_slots[slot, 7] = frame_slots[slot, 7] + wp.dot(uz, d.y)
                            frame_slots[slot, 8] = frame_slots[slot, 8] + wp.dot(uz, d.z)
                            frame_slots[slot, 9] = frame_slots[slot, 9] + wp.dot(hy, v.z) - wp.dot(hz, v.y)
                            frame_slots[slot, 10] = frame_slots[slot, 10] + wp.dot(hz, v.x) - wp.dot(hx, v.z)
                            frame_slots[slot, 11] = frame_slots[slot, 11] + wp.dot(hx, v.y) - wp.dot(hy, v.x)
                            ray_x = ray_x + ux * frames[i, 0] + uy * frames[i, 3] + uz * frames[i, 6]
                            ray_y = ray_y + ux * frames[i, 1] + uy * frames[i, 4] + uz * frames[i, 7]
                            ray_z = ray_z + ux * frames[i, 2] + uy * frames[i, 5] + uz * frames[i, 8]
                        else:
                            k1 = record[K]
                            m = record[M]
                            dy = y - record[Y]
                            x = column - lanes(record[X] - x0 + m * dy)
                            dsx = wp.dot(ds, x)
                            slots[slot, G_X] = slots[slot, G_X] - 2.0 * k1 * k1 * dsx
                            slots[slot, G_Y] = slots[slot, G_Y] + 2.0 * k1 * k1 * m * dsx - 2.0 * record[H] * dy * wp.dot(ds, one)
                            slots[slot, G_K] = slots[slot, G_K] + 2.0 * k1 * wp.dot(wp.cw_mul(ds, x), x)
                            slots[slot, G_M] = slots[slot, G_M] - 2.0 * k1 * k1 * dy * dsx
                            slots[slot, G_H] = slots[slot, G_H] + dy * dy * wp.dot(ds, one)
                if wp.static(ray):
                    g_rays[0, row, tx] = ray_x
                    g_rays[1, row, tx] = ray_y
                    g_rays[2, row, tx] = ray_z

    return composite_rays_backward
