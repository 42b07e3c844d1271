"""Which tiles a splat touches, exactly, and the tiles' lists in depth order.

Projection, which has a record at hand, notes what tiles the ellipse reaches in 16 bytes (`reach`): dealing reads splats in depth order,
all over memory, and records would not stay in the caches. What covers more than 8 rows or 16 columns of tiles is looked up in its record.
Room for a splat's entries is set aside by the box around its ellipse.
"""

import warp as wp

from render.kernels.types import OPTIONS, S_MAX, SLACK, TILE, Y_AT_EXT, Y_EXT, H, K, M, Window, X, Y

wp.set_module_options(OPTIONS)

TILE_SIZE = wp.constant(float(TILE))
LAST_CENTRE = wp.constant(TILE - 0.5)
FAR = wp.constant(1.0e6)
ROOM = wp.constant(1.0001)  # the box that sets room aside is this much wider than the ellipse, whatever rounding does to either

REACH_INTS = 4
"""Ints of a splat's reach: first row and column of tiles, then a bit for each of 8x8 tiles from there, row by row, in two halves."""
SIDE = wp.constant(8)
WORD = wp.constant(wp.int64(0xFFFFFFFF))
ONE = wp.constant(wp.int64(1))
WITH_SLOTS = wp.constant(2)
EVERY_ROW = wp.constant(wp.int64(0x0101010101010101))
EVERY_TILE = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))


@wp.func
def span_of(centre: float, reach: float):
    """First and last of the tiles along one direction whose pixel centres lie within `reach` of `centre`; empty where last < first."""
    first = wp.ceil((wp.clamp(centre - reach - SLACK, -FAR, FAR) - LAST_CENTRE) / TILE_SIZE)
    last = wp.floor((wp.clamp(centre + reach + SLACK, -FAR, FAR) - 0.5) / TILE_SIZE)
    return wp.vec2i(int(first), int(last))


@wp.func
def within(span: wp.vec2i, start: int, tiles: int):
    """Those of the span among `tiles` tiles from `start`."""
    return wp.vec2i(wp.max(span[0], start), wp.min(span[1], start + tiles - 1))


@wp.func
def columns_of(records: wp.array2d[float], j: int, ty: int):
    """First and last tile of tile row ty that the ellipse reaches: its extreme x over the row's span of y."""
    inv_k = 1.0 / records[j, K]
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
    return span_of(records[j, X] + 0.5 * (left + right), 0.5 * (right - left))


@wp.func
def bits_within(first: int, start: int, count: int):
    """Of 8 numbers from `first`, as bits, those of the `count` from `start`."""
    low = wp.clamp(start - first, 0, SIDE)
    high = wp.clamp(start + count - first, low, SIDE)
    return (1 << high) - (1 << low)


@wp.func
def bits_of_rows(low: int, high: int):
    """The rows from low to before high, of 8x8 bits."""
    return wp.where(high > low, wp.int64((EVERY_TILE >> wp.uint64(SIDE * (low + SIDE - high))) << wp.uint64(SIDE * low)), wp.int64(0))


@wp.func
def note_reach(records: wp.array2d[float], j: int, rows: wp.vec2i, columns: wp.vec2i, reach: wp.array2d[int]):
    """Write reach j of a record that is written; rows, columns: of the box around it. No bits: the record must be asked."""
    high = rows[1] - rows[0] + 1
    wide = columns[1] - columns[0] + 1
    bits = wp.int64(0)
    if high <= SIDE and wide <= SIDE:
        bits = (wp.int64((1 << wide) - 1) * EVERY_ROW) & bits_of_rows(0, high)
        if high > 1 and wide > 1:
            bits = wp.int64(0)
            for row in range(high):
                here = within(columns_of(records, j, rows[0] + row), columns[0], wide)
                bits = bits | (wp.int64(bits_within(columns[0], here[0], here[1] - here[0] + 1)) << wp.int64(SIDE * row))
    reach[j, 0] = rows[0]
    reach[j, 1] = columns[0]
    reach[j, 2] = int(bits & WORD)
    reach[j, 3] = int(bits >> wp.int64(32))


@wp.func
def tiles_reached(reach: wp.array2d[int], j: int, window: Window):
    """The window's tiles of reach j, as 8x8 bits."""
    bits = (wp.int64(reach[j, 2]) & WORD) | (wp.int64(reach[j, 3]) << wp.int64(32))
    low = wp.clamp(window.top - reach[j, 0], 0, SIDE)
    high = wp.clamp(window.top + window.tiles_y - reach[j, 0], 0, SIDE)
    return bits & bits_of_rows(low, high) & (wp.int64(bits_within(reach[j, 1], window.left, window.tiles_x)) * EVERY_ROW)


@wp.func
def deal_entry(
    j: int, ty: int, tx: int, window: Window, drawn: wp.array2d[int], part: int, cursor: wp.array2d[int], emit: int, slot: int,
    ids: wp.array[int], slot_of: wp.array[int],
):  # fmt: skip
    """Count an entry, or write it where the cursor stands; returns how many there are."""
    entries = int(0)
    if drawn[ty, tx] != 0:
        tile = (ty - window.top) * window.tiles_x + tx - window.left
        k = cursor[part, tile]
        cursor[part, tile] = k + 1
        if emit != 0:
            ids[k] = j
            if emit == WITH_SLOTS:
                slot_of[k] = slot
        entries = 1
    return entries


@wp.kernel
def set_room_aside(records: wp.array2d[float], counts: wp.array[int], window: Window, room: wp.array[int], first: int):
    """Tiles of the window within the box around each ellipse: as many entries as it can have there at most."""
    j = first + wp.tid()
    room[j] = 0
    if counts[j] > 0:
        k = records[j, K]
        m = records[j, M]
        h = records[j, H]
        reach = wp.sqrt(records[j, S_MAX] * (k * k * m * m + h) / h) / k
        rows = within(span_of(records[j, Y], ROOM * records[j, Y_EXT] + SLACK), window.top, window.tiles_y)
        columns = within(span_of(records[j, X], ROOM * reach + SLACK), window.left, window.tiles_x)
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
def deal(
    records: wp.array2d[float], reach: wp.array2d[int], order: wp.array[int], visible: int, chunk: int, window: Window,
    drawn: wp.array2d[int], cursor: wp.array2d[int], emit: int, counts: wp.array[int], slots: wp.array[int], ids: wp.array[int],
    slot_of: wp.array[int],
    first: int,
):  # fmt: skip
    """A stable counting sort's two passes; a thread takes one chunk of the depth-ordered splats. Both must see the same tiles, to the bit,
    and so are the same code. reach, counts and slots (where a splat's gradient slots begin) are in depth order: what the loop branches
    on must not wait for far memory.

    First, with emit = 0 and `cursor` `[chunks, tiles]` zeroed, which leaves there how many entries of each tile every chunk has, and in
    counts each splat's; then with `cursor` where each chunk's entries of each tile begin. drawn: 0 for tiles of the image that shall have
    no entries.
    """
    part = first + wp.tid()
    for d in range(part * chunk, wp.min(part * chunk + chunk, visible)):
        j = order[d]
        entries = int(0)
        slot = int(0)
        if emit == WITH_SLOTS:
            slot = slots[d]
        if reach[d, 2] == 0 and reach[d, 3] == 0:
            rows = within(span_of(records[j, Y], records[j, Y_EXT]), window.top, window.tiles_y)
            for ty in range(rows[0], rows[1] + 1):
                columns = within(columns_of(records, j, ty), window.left, window.tiles_x)
                for tx in range(columns[0], columns[1] + 1):
                    entries += deal_entry(j, ty, tx, window, drawn, part, cursor, emit, slot + entries, ids, slot_of)
        else:
            bits = tiles_reached(reach, d, window)
            while bits != wp.int64(0):
                q = wp.bit_count((bits & -bits) - ONE)
                bits = bits & (bits - ONE)
                ty = reach[d, 0] + q // SIDE
                tx = reach[d, 1] + q % SIDE
                entries += deal_entry(j, ty, tx, window, drawn, part, cursor, emit, slot + entries, ids, slot_of)
        counts[d] = entries


@wp.kernel
def emit_pairs(
    records: wp.array2d[float], order: wp.array[int], window: Window, drawn: wp.array2d[int], in_order: wp.array[int],
    ends: wp.array[wp.int64], room: int, counts: wp.array[int], first_slot: wp.array[int], tile_of: wp.array[int], owner: wp.array[int],
    first: int,
):  # fmt: skip
    """CUDA: one thread a splat writes the tile of each of its slots, in depth order; a stable sort of slots by tile then makes the lists.
    in_order, ends: room set aside for each splat by depth, and its running sum. counts becomes how many entries each has. A slot that no
    entry is written to keeps what tile it was given before."""
    d = first + wp.tid()
    j = order[d]
    begin = int(wp.min(ends[d] - wp.int64(in_order[d]), wp.int64(room)))
    first_slot[j] = begin
    if in_order[d] > 0:
        slot = begin
        end = slot + wp.min(in_order[d], room - slot)
        rows = within(span_of(records[j, Y], records[j, Y_EXT]), window.top, window.tiles_y)
        for ty in range(rows[0], rows[1] + 1):
            columns = within(columns_of(records, j, ty), window.left, window.tiles_x)
            for tx in range(columns[0], wp.min(columns[1], columns[0] + end - slot - 1) + 1):
                if drawn[ty, tx] != 0:
                    tile_of[slot] = (ty - window.top) * window.tiles_x + tx - window.left
                    owner[slot] = j
                    slot += 1
        counts[j] = slot - begin


@wp.kernel
def cut_lists(
    by_tile: wp.array[wp.int64], tile_of: wp.array[int], owner: wp.array[int], tiles: int, starts: wp.array[int], ids: wp.array[int],
    slot_of: wp.array[int],
    first: int,
):  # fmt: skip
    """CUDA: one thread an entry; by_tile: slots sorted by tile. Each list begins where the tile is another than the entry before's;
    behind all tiles are those of no entry."""
    k = first + wp.tid()
    slot = int(by_tile[k])
    slot_of[k] = slot
    ids[k] = owner[slot]
    tile = tile_of[slot]
    before = int(-1)
    if k > 0:
        before = tile_of[int(by_tile[k - 1])]
    for beginning in range(before + 1, tile + 1):
        starts[beginning] = k
    if k + 1 == by_tile.shape[0]:
        for beginning in range(tile + 1, tiles + 1):
            starts[beginning] = k + 1
