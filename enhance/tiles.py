"""Where there is something to do: the tiles of a frame that its need map asks for, gathered into the windows that are worked on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch.nn import functional as F

TILE = 32
"""Pixels of a tile's side."""

CELL = 8
NEEDED = 0.25
"""Mean need of a cell of CELL x CELL pixels from which its tile is worked on: single pixels always need something."""

MARGIN = 1
"""Tiles around those worked on that are looked at, too."""

LARGEST = 40
"""Tiles a side (1280 pixels) of a window: attention over more costs more than twice for twice, and was not trained for."""

MOST = 0.75
"""Of the frame: windows that cover more are slower than the whole, whose picture is the better one."""

Window = tuple[slice, slice]


@dataclass(frozen=True)
class Tiles:
    """needed: bool `[rows, columns]`, which tiles of a frame of `height` x `width` pixels are worked on."""

    needed: np.ndarray
    height: int
    width: int

    @classmethod
    def of(cls, need: torch.Tensor) -> Tiles:
        """Of a need map `[H, W]` in 0..1."""
        height, width = need.shape
        pad = (0, -width % TILE, 0, -height % TILE)
        cells = F.avg_pool2d(F.pad(need.float()[None, None], pad, mode="replicate"), CELL)
        tiles = F.max_pool2d(cells, TILE // CELL)[0, 0] > NEEDED
        return cls(tiles.cpu().numpy(), height, width)

    def nothing(self) -> bool:
        return not self.needed.any()

    def windows(self) -> list[tuple[Window, Window]]:
        """Rows and columns of rectangles in pixels, each around tiles that touch or nearly do, one of the whole frame where that is less
        work; and the part of each whose result counts: a rectangle of more than LARGEST tiles a side is worked on in parts that
        overlap. They may reach past the frame by part of a tile."""
        around = ndimage.binary_dilation(self.needed, np.ones((3, 3)), MARGIN)
        boxes = ndimage.find_objects(ndimage.label(around, np.ones((3, 3)))[0])
        if sum(self.needed[box].size for box in boxes) > MOST * self.needed.size:
            boxes = [(slice(0, self.needed.shape[0]), slice(0, self.needed.shape[1]))]
        parts = [(r, c) for rows, columns in boxes for r in _parts(rows) for c in _parts(columns)]
        return [((_scaled(r[0]), _scaled(c[0])), (_scaled(r[1]), _scaled(c[1]))) for r, c in parts]

    def everything(self) -> bool:
        """Whether the whole frame is one window."""
        whole = slice(0, TILE * self.needed.shape[0]), slice(0, TILE * self.needed.shape[1])
        return any(window == whole for window, _ in self.windows())

    def pixels(self) -> torch.Tensor:
        """The tiles as a mask, bool `[H, W]`."""
        grown = torch.from_numpy(self.needed.repeat(TILE, 0).repeat(TILE, 1))
        return grown[: self.height, : self.width]


def _parts(tiles: slice) -> list[tuple[slice, slice]]:
    """Equal parts of at most LARGEST tiles: with a margin towards each other, and without."""
    length = tiles.stop - tiles.start
    count = -(-length // LARGEST)
    ends = [tiles.start + round(i * length / count) for i in range(count + 1)]
    cores = [slice(a, b) for a, b in zip(ends, ends[1:], strict=False)]
    return [(slice(max(c.start - MARGIN, tiles.start), min(c.stop + MARGIN, tiles.stop)), c) for c in cores]


def _scaled(tiles: slice) -> slice:
    return slice(tiles.start * TILE, tiles.stop * TILE)


def within(window: Window, height: int, width: int) -> Window:
    """A window cut off where a frame ends."""
    rows, columns = window
    return slice(rows.start, min(rows.stop, height)), slice(columns.start, min(columns.stop, width))


def coarser(window: Window, by: int) -> Window:
    """A window on a grid whose cells are `by` pixels wide."""
    rows, columns = window
    return slice(rows.start // by, -(-rows.stop // by)), slice(columns.start // by, -(-columns.stop // by))
