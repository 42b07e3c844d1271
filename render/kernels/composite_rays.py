"""Compositing ray by ray, for the CPU: the response of the 3D Gaussian along each pixel's ray, and each pixel's own order of depth.

Response "ray" takes the least exponent along the ray for the conic's; order "pixel" sorts by its place (`ray_rows.py`). A row of a tile
makes a list of the entries that reach it, one lane vector an entry. Where every pixel's order is the list's, it is gone through as it
stands; else its keys are sorted, all lanes at once, and each pixel takes its next entry's alpha and leaves the weight there. Then every
entry adds its colour by its weights: so colours are never gathered. Backward makes the same list and goes through it from its end.
"""

from functools import cache

import warp as wp

from render.kernels.canonical import CENTRE, GROUP
from render.kernels.lanewise import below, voted
from render.kernels.ray_rows import (
    ALPHA,
    NONE,
    PICKED,
    SHADE,
    THROUGH,
    WEIGHT,
    dot,
    entry,
    lanes64,
    list_row,
    ray_functions,
    reach_of,
    square,
)
from render.kernels.rows import ROLLED, corner_of
from render.kernels.types import (
    BLUE,
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
    GREEN,
    INSTANCE,
    MEDIAN,
    OPACITY,
    RED,
    TILE,
    WHO,
    X_REST,
    Y_REST,
    H,
    K,
    M,
    Wanted,
    Window,
    X,
    Y,
    lanes,
)

SUMS = GRADIENTS + 12
"""Sums of a tile's entry: a gradient slot, and d loss / d (A, p) of its canonical frame."""
TWO = wp.constant(wp.float64(2.0))


@wp.func
def gathered(scattered: wp.array4d[float], band: int, field: int, keys: wp.array[wp.float64], place: int, entries: int):
    """A field of each lane's own entry at a place of its order."""
    out = lanes(0.0)
    for j in range(TILE):
        out[j] = scattered[band, field, entry(keys, place, j, entries), j]
    return out


@wp.func
def scatter(scattered: wp.array4d[float], band: int, field: int, keys: wp.array[wp.float64], place: int, entries: int, values: lanes):
    for j in range(TILE):
        scattered[band, field, entry(keys, place, j, entries), j] = values[j]


@cache
def composite_rays(wanted: Wanted, ray: bool, eyes: bool, ordered: bool, squarings: int):
    """The forward kernel, for response "ray" or "conic", in each pixel's own order or the tiles'. eyes: as of `ray_functions`."""
    make = list_row(ray, eyes, ordered, squarings)
    _, _, _, depth = ray_functions(ray, eyes, squarings)

    @wp.kernel(module="unique", module_options=ROLLED, enable_backward=False)
    def composite_rays_forward(
        tile_starts: wp.array[int], ids: wp.array[int], records: wp.array[lanes], slopes: wp.array[wp.vec2],
        frames: wp.array2d[wp.float64],
        features: wp.array2d[float], channels: int, rays: wp.array4d[lanes64], elsewhere: wp.array[int],
        window: Window, bands: int, alpha_max: float, termination: float, entries: int,
        columns: wp.array[lanes], lists: wp.array3d[lanes], scattered: wp.array4d[float], keys: wp.array[lanes64],
        keys_by_lane: wp.array[wp.float64], reach: wp.array3d[int],
        planes: wp.array3d[lanes], picks: wp.array3d[lanes],
        first: int,
    ):  # fmt: skip
        """elsewhere: 1 for tiles that are drawn by another kernel. lists `[bands, LISTS, longest tile list]`, scattered, the same memory by
        lane, keys `[bands * longest]`, and by lane, reach `[bands, 3, longest]`, the first and last row of each entry and which of them
        stand in the row's list: working memory. entries: a power of two, at least the longest list."""
        band = first + wp.tid()
        column = columns[0]
        tiles = window.tiles_x * window.tiles_y
        for tile in range(band * tiles // bands, (band + 1) * tiles // bands):
            if elsewhere[tile] == 0:
                tx, row0, x0, y0 = corner_of(window, tile)
                start = tile_starts[tile]
                stop = tile_starts[tile + 1]
                reach_of(records, ids, start, stop, x0, y0, band, reach)
                first_key = band * reach.shape[2]
                for r in range(TILE):
                    row = row0 + r
                    count, crossing = make(
                        ids, start, stop, records, frames, reach, rays, column, x0, y0 + float(r), row, tx, r, band,
                        alpha_max, termination, entries, first_key, lists, keys, keys_by_lane,
                    )  # fmt: skip
                    for m in range(count):
                        lists[band, WEIGHT, m] = lanes(0.0)
                        if wp.static(wanted.median):
                            lists[band, PICKED, m] = lanes(0.0)
                    t = lanes(1.0)
                    for k in range(count):
                        if (k & 7) == 0:  # noqa: SIM102 - looking costs more than drawing one
                            if wp.max(t) < termination:
                                break
                        a = lists[band, ALPHA, k]
                        if crossing:
                            a = gathered(scattered, band, ALPHA, keys_by_lane, first_key + k, entries)
                        w = wp.cw_mul(t, a)
                        if crossing:
                            scatter(scattered, band, WEIGHT, keys_by_lane, first_key + k, entries, w)
                        else:
                            lists[band, WEIGHT, k] = w
                        if wp.static(wanted.median):
                            here = wp.cw_mul(below(0.5, t - w), lanes(1.0) - below(0.5, t))
                            if crossing:
                                scatter(scattered, band, PICKED, keys_by_lane, first_key + k, entries, here)
                            else:
                                lists[band, PICKED, k] = here
                        t = t - w
                    red = lanes(0.0)
                    green = lanes(0.0)
                    blue = lanes(0.0)
                    z = lanes(0.0)
                    weights = lanes(0.0)
                    median = lanes(0.0)
                    who = lanes(-1.0)
                    lead = lanes(0.0)
                    if wp.static(wanted.channels):
                        for c in range(channels):
                            planes[wp.static(wanted.first_channel) + c, row, tx] = lanes(0.0)
                    for m in range(count):
                        i = ids[start + reach[band, 2, m]]
                        record = records[i]
                        w = lists[band, WEIGHT, m]
                        red = red + w * record[RED]
                        green = green + w * record[GREEN]
                        blue = blue + w * record[BLUE]
                        if wp.static(wanted.depths):
                            far = depth(record, slopes, frames, i, rays, column, x0, y0, row, tx, r)
                        if wp.static(wanted.depth):
                            z = z + wp.cw_mul(w, far)
                            weights = weights + w
                        if wp.static(wanted.channels):
                            for c in range(channels):
                                p = wp.static(wanted.first_channel) + c
                                planes[p, row, tx] = planes[p, row, tx] + w * features[i, c]
                        if wp.static(wanted.median):
                            median = median + wp.cw_mul(lists[band, PICKED, m], far)
                        if wp.static(wanted.instance):
                            who, lead = voted(who, lead, record[INSTANCE], w)
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
def composite_rays_gradient(wanted: Wanted, ray: bool, eyes: bool, ordered: bool, squarings: int):
    """The backward kernel: writes every entry's gradient slot, those of its channels and of its canonical frame, and the rays' gradient."""
    make = list_row(ray, eyes, ordered, squarings)
    canonical, faded_conic, faded_along, depth = ray_functions(ray, eyes, squarings)

    @wp.kernel(module="unique", module_options=ROLLED, enable_backward=False)
    def composite_rays_backward(
        tile_starts: wp.array[int], ids: wp.array[int], slot_of: wp.array[int], records: wp.array[lanes], slopes: wp.array[wp.vec2],
        frames: wp.array2d[wp.float64],
        features: wp.array2d[float], channels: int, rays: wp.array4d[lanes64], elsewhere: wp.array[int],
        window: Window, bands: int, alpha_max: float, termination: float, entries: int,
        columns: wp.array[lanes], lists: wp.array3d[lanes], scattered: wp.array4d[float], keys: wp.array[lanes64],
        keys_by_lane: wp.array[wp.float64], reach: wp.array3d[int],
        planes: wp.array3d[lanes], grads: wp.array3d[lanes],
        sums: wp.array3d[wp.float64],
        slots: wp.array2d[float], channel_slots: wp.array2d[float], frame_slots: wp.array2d[float], g_rays: wp.array4d[lanes64],
        first: int,
    ):  # fmt: skip
        """grads: as for `composite_gradient`; g_rays: zeroed before. sums `[bands, longest, SUMS]`: working memory, for the gradients of
        needles cancel from row to row."""
        band = first + wp.tid()
        column = columns[0]
        one = lanes(1.0)
        one64 = lanes64(wp.float64(1.0))
        tiles = window.tiles_x * window.tiles_y
        for tile in range(band * tiles // bands, (band + 1) * tiles // bands):
            if elsewhere[tile] == 0:
                tx, row0, x0, y0 = corner_of(window, tile)
                start = tile_starts[tile]
                stop = tile_starts[tile + 1]
                reach_of(records, ids, start, stop, x0, y0, band, reach)
                for j in range(stop - start):
                    for c in range(SUMS):
                        sums[band, j, c] = NONE
                    if wp.static(wanted.channels):
                        for c in range(channels):
                            channel_slots[slot_of[start + j], c] = 0.0
                first_key = band * reach.shape[2]
                for r in range(TILE):
                    row = row0 + r
                    y = y0 + float(r)
                    count, crossing = make(
                        ids, start, stop, records, frames, reach, rays, column, x0, y, row, tx, r, band,
                        alpha_max, termination, entries, first_key, lists, keys, keys_by_lane,
                    )  # fmt: skip
                    gr = grads[1, row, tx]
                    gg = grads[2, row, tx]
                    gb = grads[3, row, tx]
                    for m in range(count):
                        i = ids[start + reach[band, 2, m]]
                        record = records[i]
                        shade = gr * record[RED] + gg * record[GREEN] + gb * record[BLUE]
                        if wp.static(wanted.depth):
                            far = depth(record, slopes, frames, i, rays, column, x0, y0, row, tx, r)
                            shade = shade + wp.cw_mul(grads[4, row, tx], far) + grads[5, row, tx]
                        if wp.static(wanted.channels):
                            for c in range(channels):
                                shade = shade + grads[wp.static(wanted.first_channel) + c, row, tx] * features[i, c]
                        lists[band, SHADE, m] = shade
                        lists[band, WEIGHT, m] = lanes(0.0)
                        lists[band, PICKED, m] = lanes(0.0)
                    t = lanes(1.0)
                    seen = int(0)
                    for k in range(count):
                        if (k & 7) == 0:  # noqa: SIM102 - as forward
                            if wp.max(t) < termination:
                                break
                        a = lists[band, ALPHA, k]
                        if crossing:
                            a = gathered(scattered, band, ALPHA, keys_by_lane, first_key + k, entries)
                        lists[band, THROUGH, k] = t
                        t = t - wp.cw_mul(t, a)
                        seen += 1
                    rest = grads[0, row, tx] * 1.0
                    for back in range(seen):
                        k = seen - 1 - back
                        a = lists[band, ALPHA, k]
                        shade = lists[band, SHADE, k]
                        if crossing:
                            a = gathered(scattered, band, ALPHA, keys_by_lane, first_key + k, entries)
                            shade = gathered(scattered, band, SHADE, keys_by_lane, first_key + k, entries)
                        through = lists[band, THROUGH, k]
                        w = wp.cw_mul(through, a)
                        da = wp.cw_mul(through, shade) - wp.cw_div(rest, one - a)
                        rest = rest + wp.cw_mul(w, shade)
                        if crossing:
                            scatter(scattered, band, WEIGHT, keys_by_lane, first_key + k, entries, w)
                            scatter(scattered, band, PICKED, keys_by_lane, first_key + k, entries, da)
                        else:
                            lists[band, WEIGHT, k] = w
                            lists[band, PICKED, k] = da
                    for m in range(count):
                        j = reach[band, 2, m]
                        w = lists[band, WEIGHT, m]
                        da = lists[band, PICKED, m]
                        i = ids[start + j]
                        record = records[i]
                        opacity = record[OPACITY]
                        e = lanes(0.0)
                        if wp.static(ray):
                            ux, uy, uz, qx, qy, qz = canonical(frames, i, rays, row, tx)
                            e = faded_along(record, column, x0, ux, uy, uz, qx, qy, qz)
                        else:
                            e = faded_conic(record, column, x0, y)
                        de = wp.cw_mul(wp.cw_mul(da, e), below(alpha_max, e * opacity))
                        sums[band, j, G_OPACITY] = sums[band, j, G_OPACITY] + wp.float64(wp.dot(de, one))
                        sums[band, j, G_RED] = sums[band, j, G_RED] + wp.float64(wp.dot(w, gr))
                        sums[band, j, G_GREEN] = sums[band, j, G_GREEN] + wp.float64(wp.dot(w, gg))
                        sums[band, j, G_BLUE] = sums[band, j, G_BLUE] + wp.float64(wp.dot(w, gb))
                        if wp.static(wanted.channels):
                            for c in range(channels):
                                g_c = grads[wp.static(wanted.first_channel) + c, row, tx]
                                channel_slots[slot_of[start + j], c] = channel_slots[slot_of[start + j], c] + wp.dot(w, g_c)
                        ds = de * (-opacity)
                        if wp.static(ray):
                            # s is least at t, so dt changes nothing: ds/dq = m, ds/du = -t m, with q = A (p - o), u = A d
                            inverse = wp.cw_div(one64, square(ux, uy, uz))
                            t64 = wp.cw_mul(dot(ux, uy, uz, qx, qy, qz), inverse)
                            mx = wp.cw_mul(lanes64(ds), qx - wp.cw_mul(t64, ux))
                            my = wp.cw_mul(lanes64(ds), qy - wp.cw_mul(t64, uy))
                            mz = wp.cw_mul(lanes64(ds), qz - wp.cw_mul(t64, uz))
                            group = int(0)
                            if wp.static(eyes):
                                group = int(frames[i, GROUP])
                            if wp.static(wanted.depth):
                                # depth is t itself: dt/dq = u / |u|^2, dt/du = (q - 2 t u) / |u|^2
                                g_far = wp.cw_mul(lanes64(wp.cw_mul(w, grads[4, row, tx])), inverse)
                                twice = t64 * TWO
                                vx = wp.cw_mul(g_far, qx - wp.cw_mul(twice, ux))
                                vy = wp.cw_mul(g_far, qy - wp.cw_mul(twice, uy))
                                vz = wp.cw_mul(g_far, qz - wp.cw_mul(twice, uz))
                                wx = wp.cw_mul(g_far, ux)
                                wy = wp.cw_mul(g_far, uy)
                                wz = wp.cw_mul(g_far, uz)
                            for c in range(3):
                                ahead = rays[group, c, row, tx]
                                away = lanes64(frames[i, CENTRE + c])
                                if wp.static(eyes):
                                    away = away - rays[group, 3 + c, row, tx]
                                missed = away - wp.cw_mul(t64, ahead)
                                pushed = mx * frames[i, c] + my * frames[i, 3 + c] + mz * frames[i, 6 + c]
                                g_rays[group, c, row, tx] = g_rays[group, c, row, tx] - wp.cw_mul(t64, pushed)
                                of_x = wp.dot(mx, missed)
                                of_y = wp.dot(my, missed)
                                of_z = wp.dot(mz, missed)
                                if wp.static(wanted.depth):
                                    of_x += wp.dot(wx, away) + wp.dot(vx, ahead)
                                    of_y += wp.dot(wy, away) + wp.dot(vy, ahead)
                                    of_z += wp.dot(wz, away) + wp.dot(vz, ahead)
                                    by_u = vx * frames[i, c] + vy * frames[i, 3 + c] + vz * frames[i, 6 + c]
                                    g_rays[group, c, row, tx] = g_rays[group, c, row, tx] + by_u
                                    pushed = pushed + wx * frames[i, c] + wy * frames[i, 3 + c] + wz * frames[i, 6 + c]
                                if wp.static(eyes):
                                    g_rays[group, 3 + c, row, tx] = g_rays[group, 3 + c, row, tx] - pushed
                                sums[band, j, GRADIENTS + c] = sums[band, j, GRADIENTS + c] + of_x
                                sums[band, j, GRADIENTS + 3 + c] = sums[band, j, GRADIENTS + 3 + c] + of_y
                                sums[band, j, GRADIENTS + 6 + c] = sums[band, j, GRADIENTS + 6 + c] + of_z
                                sums[band, j, GRADIENTS + CENTRE + c] = sums[band, j, GRADIENTS + CENTRE + c] + wp.dot(pushed, one64)
                        else:
                            k1 = wp.float64(record[K])
                            m1 = wp.float64(record[M])
                            above = (y - record[Y]) - record[Y_REST]
                            dy = wp.float64(above)
                            ds64 = lanes64(ds)
                            x = lanes64(column - lanes((record[X] - x0) + record[X_REST] + record[M] * above))
                            slope = TWO * k1 * k1 * wp.dot(ds64, x)
                            per_y = dy * wp.dot(ds64, one64)
                            sums[band, j, G_X] = sums[band, j, G_X] - slope
                            sums[band, j, G_Y] = sums[band, j, G_Y] + m1 * slope - TWO * wp.float64(record[H]) * per_y
                            sums[band, j, G_K] = sums[band, j, G_K] + TWO * k1 * wp.dot(wp.cw_mul(ds64, x), x)
                            sums[band, j, G_M] = sums[band, j, G_M] - dy * slope
                            sums[band, j, G_H] = sums[band, j, G_H] + dy * per_y
                            if wp.static(wanted.depth):
                                gz = wp.cw_mul(w, grads[4, row, tx])
                                at = wp.float64(wp.dot(gz, one))
                                beside = column - lanes(record[X] - x0)
                                sums[band, j, G_Z] = sums[band, j, G_Z] + at
                                sums[band, j, G_ALONG] = sums[band, j, G_ALONG] + wp.float64(wp.dot(gz, beside))
                                sums[band, j, G_DOWN] = sums[band, j, G_DOWN] + wp.float64(y - record[Y]) * at
                for j in range(stop - start):
                    slot = slot_of[start + j]
                    for c in range(GRADIENTS):
                        slots[slot, c] = float(sums[band, j, c])
                    if wp.static(ray):
                        for c in range(SUMS - GRADIENTS):
                            frame_slots[slot, c] = float(sums[band, j, GRADIENTS + c])

    return composite_rays_backward
