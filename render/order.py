"""Depth order and the tiles' lists: from projected records to what compositing reads."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from render.kernels.bin import count_chunks, emit_chunks, emit_pairs
from render.kernels.types import CULLED, Window
from render.launch import run, sort_pairs, view

CHUNKS = 8
"""Chunks of the depth order that are counted and emitted side by side on CPU threads."""


@dataclass(frozen=True)
class TileLists:
    """What every tile composites, front to back. All int32.

    starts `[tiles + 1]`, ids `[I]` (record of each entry; the first starts[-1] count), slot_of `[I]` (its gradient slot),
    first_slot `[N]` (where a record's slots begin; they lie side by side, so that its gradient is one contiguous sum in fixed order).
    """

    starts: torch.Tensor
    ids: torch.Tensor
    slot_of: torch.Tensor
    first_slot: torch.Tensor


def depth_order(keys: torch.Tensor) -> torch.Tensor:
    """Indices int32 of the records that are not culled, by rising depth, ties by index."""
    visible = torch.nonzero(keys != int(CULLED)).flatten().to(torch.int32)
    n = visible.shape[0]
    pair = keys.new_empty(2, 2 * n)
    pair[0, :n] = keys[visible]
    pair[1, :n] = visible
    if n:
        sort_pairs(pair[0], pair[1], n)
    return pair[1, :n]


def tile_lists(
    records: torch.Tensor, order: torch.Tensor, counts: torch.Tensor, window: Window, drawn: torch.Tensor, counting: bool = True
) -> TileLists:
    """Deal the visible records, sorted by depth, to the window's tiles: by a stable counting pass, or (CUDA) by a stable sort of tiles.

    counts `[N]`: entries to set aside for each record; replaced by how many it has. drawn int32 `[tiles_y, tiles_x]` of the image: 0 for
    tiles that shall have no entries.
    """
    device, tiles = records.device, window.tiles_x * window.tiles_y
    visible = order.shape[0]
    ends = counts[order].cumsum(0)
    total = int(ends[-1]) if visible else 0
    first_slot = torch.empty_like(counts)
    first_slot[order] = (ends - counts[order]).to(torch.int32)
    ids = torch.empty(total, dtype=torch.int32, device=device)
    slot_of = torch.empty(total, dtype=torch.int32, device=device)
    starts = torch.zeros(tiles + 1, dtype=torch.int32, device=device)
    if total and counting:
        chunk = -(-visible // CHUNKS)
        histogram = torch.zeros(CHUNKS, tiles, dtype=torch.int32)
        tile_keys = torch.empty(total, dtype=torch.int32)
        args = [view(records, float), view(order, int), visible, chunk, window, view(drawn, int), view(first_slot, int)]
        run(count_chunks, CHUNKS, [*args, view(counts, int), view(histogram, int), view(tile_keys, int)], device)
        by_tile = histogram.t().reshape(-1)
        after = by_tile.cumsum(0, dtype=torch.int32)
        starts[1:] = after[CHUNKS - 1 :: CHUNKS]
        cursor = (after - by_tile).reshape(tiles, CHUNKS).t().contiguous()
        args = [view(order, int), visible, chunk, view(first_slot, int), view(counts, int), view(tile_keys, int)]
        run(emit_chunks, CHUNKS, [*args, view(cursor, int), view(ids, int), view(slot_of, int)], device)
    elif total:
        pair = torch.empty(2, 2 * total, dtype=torch.int32, device=device)
        owner = torch.empty(total, dtype=torch.int32, device=device)
        args = [view(records, float), view(order, int), window, view(drawn, int), view(first_slot, int), view(counts, int)]
        run(emit_pairs, visible, [*args, view(pair[0], int), view(pair[1], int), view(owner, int)], device)
        sort_pairs(pair[0], pair[1], total)
        slot_of = pair[1, :total].clone()
        ids = owner[slot_of.long()]
        edges = torch.arange(tiles + 1, dtype=torch.int32, device=device)
        starts = torch.searchsorted(pair[0, :total].contiguous(), edges).to(torch.int32)
    return TileLists(starts, ids, slot_of, first_slot)
