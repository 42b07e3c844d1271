"""Depth order and the tiles' lists: from projected records to what compositing reads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from render.kernels.bin import WITH_SLOTS, deal, emit_pairs
from render.kernels.types import CULLED, Window
from render.launch import run, sort_pairs, view
from render.room import Room

CHUNKS = 8
"""Chunks of the depth order that are counted and emitted side by side on CPU threads."""

MANY = 32_768
"""Records from which on torch's sort is the fastest on one core: a third of the time of numpy's for 130,000 of them, where that finds no
vectors to its liking, and as much where it does."""


@dataclass(frozen=True)
class TileLists:
    """What every tile composites, front to back. All int32.

    starts `[tiles + 1]`, ids `[I]` (record of each entry; the first starts[-1] count), slot_of `[I]` (its gradient slot),
    first_slot `[N]` (where a record's slots begin; they lie side by side, so that its gradient is one contiguous sum in fixed order).
    Where no gradient is wanted, slot_of and first_slot are empty.
    """

    starts: torch.Tensor
    ids: torch.Tensor
    slot_of: torch.Tensor
    first_slot: torch.Tensor


def depth_order(keys: torch.Tensor) -> torch.Tensor:
    """Indices int32 of the records by rising depth, ties by index; on the CPU without those that are culled, on CUDA they come last: how
    many there are is not asked."""
    if keys.device.type == "cpu":
        if len(keys) >= MANY:
            depths, order = keys.sort(stable=True)  # of so many integers torch sorts by radix
            return order[: int(torch.searchsorted(depths, int(CULLED)))].to(torch.int32)
        culled = keys.numpy()
        (there,) = np.nonzero(culled != int(CULLED))
        pairs = np.empty((len(there), 2), dtype="<i4")  # key and index in one number, which vectors sort
        pairs[:, 0], pairs[:, 1] = there, culled[there]
        pairs.reshape(-1).view("<i8").sort()
        return torch.from_numpy(pairs[:, 0].copy())
    n = len(keys)
    pair = keys.new_empty(2, 2 * n)
    pair[0, :n], pair[1, :n] = keys, torch.arange(n, dtype=torch.int32, device=keys.device)
    if n:
        sort_pairs(pair[0], pair[1], n)
    return pair[1, :n]


def tile_lists(
    records: torch.Tensor, reach: torch.Tensor, order: torch.Tensor, counts: torch.Tensor, window: Window, drawn: torch.Tensor,
    slots: bool = True, counting: bool = True, room: Room | None = None,
) -> TileLists:  # fmt: skip
    """Deal the visible records, sorted by depth, to the window's tiles: by a stable counting pass, or (CUDA) by a stable sort of tiles.

    counts `[N]`: entries to set aside for each record. drawn int32 `[tiles_y, tiles_x]` of the image: 0 for tiles that shall have no
    entries. slots: whether gradients will need slots; then counts become how many each record has. room: for as many entries, of a sort.
    """
    if len(order) == 0:
        none = torch.empty(0, dtype=torch.int32, device=records.device)
        return TileLists(none.new_zeros(window.tiles_x * window.tiles_y + 1), none, none, torch.zeros_like(counts))
    if counting:
        return _by_counting(records, reach, order, counts, window, drawn, slots)
    return _by_sorting(records, order, counts, window, drawn, room)


def _by_counting(records, reach, order, counts, window: Window, drawn, slots: bool) -> TileLists:
    tiles, visible = window.tiles_x * window.tiles_y, len(order)
    chunk = -(-visible // CHUNKS)
    cursor = torch.zeros(CHUNKS, tiles, dtype=torch.int32)
    exact = torch.empty(visible, dtype=torch.int32)
    told = [view(records, float), view(reach.index_select(0, order), int), view(order, int), visible, chunk, window, view(drawn, int)]
    none = view(exact[:0], int)
    run(deal, CHUNKS, [*told, view(cursor, int), 0, view(exact, int), none, none, none], records.device)
    by_tile = cursor.t().reshape(-1)
    after = by_tile.cumsum(0, dtype=torch.int32)
    starts = torch.zeros(tiles + 1, dtype=torch.int32)
    starts[1:] = after[CHUNKS - 1 :: CHUNKS]
    cursor = (after - by_tile).reshape(tiles, CHUNKS).t().contiguous()
    ids = torch.empty(int(starts[-1]), dtype=torch.int32)
    slot_of = begins = first_slot = exact[:0]
    if slots:
        slot_of = torch.empty_like(ids)
        counts[order] = exact
        # in the records' own order, in which the slots will be added up
        first_slot = counts.cumsum(0, dtype=torch.int32) - counts
        begins = first_slot.index_select(0, order)
    out = [view(exact, int), view(begins, int), view(ids, int), view(slot_of, int)]
    run(deal, CHUNKS, [*told, view(cursor, int), int(WITH_SLOTS) if slots else 1, *out], records.device)
    return TileLists(starts, ids, slot_of, first_slot)


def _by_sorting(records, order, counts, window: Window, drawn, room: Room | None) -> TileLists:
    device, tiles = records.device, window.tiles_x * window.tiles_y
    in_order = counts[order]
    ends = in_order.cumsum(0)
    if room is None:
        total = max(1, int(ends[-1]))
    else:
        total = room.entries
        room.note(ends[-1])
    first_slot = torch.empty_like(counts)
    first_slot[order] = (ends - in_order).clamp(max=total).to(torch.int32)
    pair = torch.zeros(2, 2 * total, dtype=torch.int32, device=device)
    pair[0] = tiles
    owner = torch.zeros(total, dtype=torch.int32, device=device)
    told = [view(records, float), view(order, int), window, view(drawn, int), view(first_slot, int), view(counts, int), total]
    run(emit_pairs, len(order), [*told, view(pair[0], int), view(pair[1], int), view(owner, int)], device)
    sort_pairs(pair[0], pair[1], total)
    slot_of = pair[1, :total].clone()
    edges = torch.arange(tiles + 1, dtype=torch.int32, device=device)
    starts = torch.searchsorted(pair[0, :total].contiguous(), edges).to(torch.int32)
    return TileLists(starts, owner[slot_of.long()], slot_of, first_slot)
