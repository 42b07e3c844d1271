"""What is drawn over a camera's pictures: a dash camera's time stamp, speed and maker's name, an editor's or a channel's logo.

It stays in the picture while the street moves through it (recon/views/staying.py), and would become splats that hang before the camera, or
paint on walls. Digits that change have edges in the same places all the same. Far-away towers, clouds and a car ahead stay as well, but
not as a whole at the top or at the foot of the picture, and away from the horizon, where such things are drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy import ndimage

from recon.log import LogCamera
from recon.views.staying import staying

WIDTH = 640
"""Width in pixels of the pictures that are searched, at most: digits are small."""

LEVEL = 0.1
"""Sine of the angle from the horizon within which things are too far away to move."""

STAYS, SURE, LEAST = 0.4, 0.6, 0.05
"""Score of an edge from which on it stays; the score that the part `LEAST` of what a drawn thing covers exceeds at least."""

DENSE, LETTER = 0.2, 0.02
"""Part of the surroundings, squares of `LETTER` of the picture's width, that such edges cover at least in what is drawn."""

BAND, SMALLEST, MOST = 0.2, 0.0005, 0.15
"""Of the picture's height, how near to its top or foot a thing is drawn; of its area, how much each covers at least, all at most."""


def drawn_over(camera: LogCamera, indices: Sequence[int], picture: Callable[[int], np.ndarray]) -> np.ndarray | None:
    """bool `[h, w]` of what is drawn over a camera's frames, in rectangles, as a picture at most `WIDTH` wide; None where nothing is.
    Arguments as those of `ego_mask`."""
    edges = staying(camera, indices, picture, WIDTH, 0.0, lambda rises: np.abs(rises) > LEVEL)
    return None if edges is None else _rectangles(edges)


def _rectangles(edges: np.ndarray) -> np.ndarray | None:
    """Those around what is drawn, from how far edges stay, 0 to 1 `[h, w]`."""
    height, width = edges.shape
    letter = max(3, round(LETTER * width))
    dense = ndimage.uniform_filter((edges > STAYS).astype(float), letter) > DENSE
    found = np.zeros((height, width), bool)
    for place in ndimage.find_objects(ndimage.label(ndimage.binary_dilation(dense, iterations=letter // 2))[0]):
        rows, columns = (slice(s.start + letter // 4, s.stop - letter // 4) for s in place)  # little more than letters
        size = (rows.stop - rows.start) * (columns.stop - columns.start)
        at_border = rows.stop <= BAND * height or rows.start >= (1 - BAND) * height
        if at_border and size >= SMALLEST * edges.size and (edges[rows, columns] > SURE).mean() > LEAST:
            found[rows, columns] = True
    return found if 0 < found.mean() <= MOST else None
