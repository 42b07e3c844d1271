"""Pictures with more splat-tile entries than memory should hold at once are drawn window by window.

A window is a rectangle of tiles. The tile grid stays anchored at the image's origin, so a window's pixels are bit for bit those of the
whole. The lists of a window are made, drawn and dropped; backward makes them again and adds each splat's gradients up in the windows'
order. So memory is bounded however many entries there are: entries are counted in int64 and no list holds more than
`RenderConfig.most_entries`, unless a single tile has more: about 12 bytes an entry forward and 50 backward.
"""

from __future__ import annotations

import torch

from render.kernels.bin import add_slots, set_room_aside
from render.kernels.types import GRADIENTS, Window
from render.launch import run, view
from render.order import TileLists


def window(left: int, top: int, tiles_x: int, tiles_y: int) -> Window:
    w = Window()
    w.left, w.top, w.tiles_x, w.tiles_y = left, top, tiles_x, tiles_y
    return w


def windows(records: torch.Tensor, counts: torch.Tensor, whole: Window, most: int) -> list[Window]:
    """The whole, or it halved until every window needs room for `most` entries at most. counts `[N]`: room in it."""
    return [whole] if int(counts.sum(dtype=torch.int64)) <= most else _halved(records, counts, whole, most)


def _halved(records: torch.Tensor, counts: torch.Tensor, w: Window, most: int) -> list[Window]:
    if w.tiles_x * w.tiles_y == 1 or int(room_in(records, counts, w).sum(dtype=torch.int64)) <= most:
        return [w]
    if w.tiles_y >= w.tiles_x:
        half = w.tiles_y // 2
        parts = [window(w.left, w.top, w.tiles_x, half), window(w.left, w.top + half, w.tiles_x, w.tiles_y - half)]
    else:
        half = w.tiles_x // 2
        parts = [window(w.left, w.top, half, w.tiles_y), window(w.left + half, w.top, w.tiles_x - half, w.tiles_y)]
    return [part for p in parts for part in _halved(records, counts, p, most)]


def room_in(records: torch.Tensor, counts: torch.Tensor, w: Window) -> torch.Tensor:
    """int32 `[N]`: how many of the window's tiles each record can reach at most."""
    room = torch.empty_like(counts)
    run(set_room_aside, len(counts), [view(records, float), view(counts, int), w, view(room, int)], records.device)
    return room


class Sums:
    """Each record's gradient, added up over windows: one slot a record."""

    def __init__(self, counts: torch.Tensor):
        self.counts = (counts > 0).to(torch.int32)
        self.starts = torch.arange(len(counts), dtype=torch.int32, device=counts.device)
        self.slots = torch.zeros(len(counts), GRADIENTS, dtype=torch.float32, device=counts.device)

    def add(self, counts: torch.Tensor, lists: TileLists, slots: torch.Tensor) -> None:
        add_to(self.slots, counts, lists, slots)


def add_to(sums: torch.Tensor, counts: torch.Tensor, lists: TileLists, slots: torch.Tensor) -> None:
    """Add each record's slots `[I, C]` to its row of `sums` `[N, C]`, in their order."""
    run(add_slots, len(counts), [view(counts, int), view(lists.first_slot, int), view(slots, float), view(sums, float)], counts.device)
