"""Depth order and the tiles' lists: from projected records to what compositing reads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from render.kernels.bin import WITH_SLOTS, cut_lists, deal, emit_pairs
from render.kernels.types import CULLED, Window
from render.launch import run, view
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
    return keys.sort(stable=True).indices.to(torch.int32)


def tile_lists(
    records: torch.Tensor, reach: torch.Tensor, order: torch.Tensor, counts: torch.Tensor, window: Window, drawn: torch.Tensor,
    slots: bool = True, counting: bool = True, room: Room | None = None, total: int | None = None,
) -> TileLists:  # fmt: skip
    """Deal the visible records, sorted by depth, to the window's tiles: by a stable counting pass, or (CUDA) by a stable sort of tiles.

    counts `[N]`: entries to set aside for each record. drawn int32 `[tiles_y, tiles_x]` of the image: 0 for tiles that shall have no
    entries. slots: whether gradients will need slots; then counts become how many each record has. Of a sort, room: for as many entries;
    total: the sum of counts, where it is known.
    """
    if len(order) == 0:
        none = torch.empty(0, dtype=torch.int32, device=records.device)
        return TileLists(none.new_zeros(window.tiles_x * window.tiles_y + 1), none, none, torch.zeros_like(counts))
    if counting:
        return _by_counting(records, reach, order, counts, window, drawn, slots)
    return _by_sorting(records, order, counts, window, drawn, room, total)


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


def _by_sorting(records, order, counts, window: Window, drawn, room: Room | None, total: int | None) -> TileLists:
    device, tiles = records.device, window.tiles_x * window.tiles_y
    in_order = counts.index_select(0, order)
    ends = in_order.cumsum(0)
    if room is not None:
        total = room.entries
        room.note(ends[-1])
    elif total is None:
        total = int(ends[-1])
    total = max(1, total)
    first_slot, owner, ids, slot_of = (torch.empty(n, dtype=torch.int32, device=device) for n in (len(counts), total, total, total))
    tile_of = torch.full((total,), tiles, dtype=torch.int32, device=device)
    told = [view(records, float), view(order, int), window, view(drawn, int), view(in_order, int), view(ends, wp.int64), total]
    out = [view(counts, int), view(first_slot, int), view(tile_of, int), view(owner, int)]
    run(emit_pairs, len(order), [*told, *out], device)
    # a radix sort goes through what keys have of bits, and tiles of all but giant pictures need no more than 16
    by_tile = (tile_of.to(torch.int16) if tiles < 2**15 else tile_of).sort(stable=True).indices
    starts = torch.empty(tiles + 1, dtype=torch.int32, device=device)
    of_entries = [view(by_tile, wp.int64), view(tile_of, int), view(owner, int), tiles]
    run(cut_lists, total, [*of_entries, view(starts, int), view(ids, int), view(slot_of, int)], device)
    return TileLists(starts, ids, slot_of, first_slot)
