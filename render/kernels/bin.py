"""Which tiles a splat touches, exactly, and the tiles' lists in depth order.

Room for a splat's entries is set aside by the box around its ellipse; `tile_columns` then finds the exact tiles, once, and their
number replaces the box's. So nothing is computed twice, and counting and emitting cannot disagree; entries past the room, which
rounding alone could ask for, are not written.
"""

import warp as wp

from render.kernels.types import INV_C, INV_K, OPTIONS, S_MAX, SLACK, TILE, Y_AT_EXT, Y_EXT, H, M, Window, X, Y

wp.set_module_options(OPTIONS)

TILE_SIZE = wp.constant(float(TILE))
LAST_CENTRE = wp.constant(TILE - 0.5)
FAR = wp.constant(1.0e6)
ROOM = wp.constant(1.0001)  # the box that sets room aside is this much wider than the ellipse, whatever rounding does to either


@wp.func
def span_within(centre: float, reach: float, start: int, tiles: int):
    """First and last of `tiles` tiles from `start` whose pixel centres lie within `reach` of `centre` along one direction; empty where
    last < first."""
    first = wp.ceil((wp.clamp(centre - reach - SLACK, -FAR, FAR) - LAST_CENTRE) / TILE_SIZE)
    last = wp.floor((wp.clamp(centre + reach + SLACK, -FAR, FAR) - 0.5) / TILE_SIZE)
    return wp.vec2i(wp.max(int(first), start), wp.min(int(last), start + tiles - 1))


@wp.func
def tile_columns(records: wp.array2d[float], j: int, ty: int, window: Window):
    """First and last tile of tile row ty that the ellipse reaches: its extreme x over the row's span of y."""
    x = records[j, X]
    inv_k = records[j, INV_K]
    m = records[j, M]
    h = records[j, H]
    s_max = records[j, S_MAX]
    y_at_ext = records[j, Y_AT_EXT]
    above = float(ty) * TILE_SIZE + 0.5 - records[j, Y] - SLACK
    below = above + LAST_CENTRE - 0.5 + 2.0 * SLACK
    dy_right = wp.clamp(y_at_ext, above, below)
    dy_left = wp.clamp(-y_at_ext, above, below)
    right = m * dy_right + wp.sqrt(wp.max(s_max - h * dy_right * dy_right, 0.0)) * inv_k
    left = m * dy_left - wp.sqrt(wp.max(s_max - h * dy_left * dy_left, 0.0)) * inv_k
    return span_within(x + 0.5 * (left + right), 0.5 * (right - left), window.left, window.tiles_x)


@wp.kernel
def set_room_aside(records: wp.array2d[float], counts: wp.array[int], window: Window, room: wp.array[int], first: int):
    """Tiles of the window within the box around each ellipse: as many entries as it can have there at most."""
    j = first + wp.tid()
    room[j] = 0
    if counts[j] > 0:
        inv_c = records[j, INV_C]
        reach = wp.sqrt(records[j, S_MAX] * inv_c / records[j, H]) * records[j, INV_K] / inv_c
        rows = span_within(records[j, Y], ROOM * records[j, Y_EXT] + SLACK, window.top, window.tiles_y)
        columns = span_within(records[j, X], ROOM * reach + SLACK, window.left, window.tiles_x)
        room[j] = wp.max(rows[1] - rows[0] + 1, 0) * wp.max(columns[1] - columns[0] + 1, 0)


@wp.kernel
def add_slots(
    counts: wp.array[int], starts: wp.array[int], slots: wp.array2d[float], sums: wp.array2d[float],
    first: int,
):  # fmt: skip
    """Add each record's gradient slots to its sum, in order."""
    j = first + wp.tid()
    for slot in range(starts[j], starts[j] + counts[j]):
        for c in range(sums.shape[1]):
            sums[j, c] = sums[j, c] + slots[slot, c]


@wp.kernel
def count_chunks(
    records: wp.array2d[float], order: wp.array[int], visible: int, chunk: int, window: Window, drawn: wp.array2d[int],
    starts: wp.array[int], counts: wp.array[int], histogram: wp.array2d[int], tile_keys: wp.array[int],
    first: int,
):  # fmt: skip
    """A thread takes one chunk of the depth-ordered splats: the tile of every slot, each splat's exact count, and the histogram
    `[chunks, tiles]` of entries a tile, zeroed before. drawn: 0 for tiles of the image that shall have no entries."""
    part = first + wp.tid()
    for d in range(part * chunk, wp.min(part * chunk + chunk, visible)):
        j = order[d]
        slot = starts[j]
        end = slot + counts[j]
        rows = span_within(records[j, Y], records[j, Y_EXT], window.top, window.tiles_y)
        for ty in range(rows[0], rows[1] + 1):
            columns = tile_columns(records, j, ty, window)
            for tx in range(columns[0], wp.min(columns[1], columns[0] + end - slot - 1) + 1):
                if drawn[ty, tx] != 0:
                    tile = (ty - window.top) * window.tiles_x + tx - window.left
                    tile_keys[slot] = tile
                    histogram[part, tile] = histogram[part, tile] + 1
                    slot += 1
        counts[j] = slot - starts[j]


@wp.kernel
def emit_chunks(
    order: wp.array[int], visible: int, chunk: int, starts: wp.array[int], counts: wp.array[int], tile_keys: wp.array[int],
    cursor: wp.array2d[int], ids: wp.array[int], slot_of: wp.array[int],
    first: int,
):  # fmt: skip
    """The stable second pass of the counting sort: `cursor` holds where each chunk's entries of each tile begin."""
    part = first + wp.tid()
    for d in range(part * chunk, wp.min(part * chunk + chunk, visible)):
        j = order[d]
        for slot in range(starts[j], starts[j] + counts[j]):
            tile = tile_keys[slot]
            k = cursor[part, tile]
            cursor[part, tile] = k + 1
            ids[k] = j
            slot_of[k] = slot


@wp.kernel
def emit_pairs(
    records: wp.array2d[float], order: wp.array[int], window: Window, drawn: wp.array2d[int], starts: wp.array[int],
    counts: wp.array[int], tile_keys: wp.array[int], slot_of: wp.array[int], owner: wp.array[int],
    first: int,
):  # fmt: skip
    """CUDA: one thread a splat writes (tile, slot) in depth order; a stable radix sort by tile then makes the lists."""
    j = order[first + wp.tid()]
    slot = starts[j]
    end = slot + counts[j]
    rows = span_within(records[j, Y], records[j, Y_EXT], window.top, window.tiles_y)
    for ty in range(rows[0], rows[1] + 1):
        columns = tile_columns(records, j, ty, window)
        for tx in range(columns[0], wp.min(columns[1], columns[0] + end - slot - 1) + 1):
            if drawn[ty, tx] != 0:
                tile_keys[slot] = (ty - window.top) * window.tiles_x + tx - window.left
                slot_of[slot] = slot
                owner[slot] = j
                slot += 1
    for spare in range(slot, end):
        tile_keys[spare] = window.tiles_x * window.tiles_y  # behind every tile
        slot_of[spare] = spare
        owner[spare] = j
    counts[j] = slot - starts[j]
