"""Where a camera's pictures show the recording car itself: its bonnet stays where it is while the street moves through the picture.

What is far away stays as well, and a car ahead at the same speed: the mask has what stays below the horizon (recon/views/staying.py) and
reaches down to the picture's edge, but for what is drawn over it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from scipy import ndimage
from torch.nn import functional as F

from recon.log import Log, LogCamera
from recon.views.drawn_over import drawn_over
from recon.views.image_circle import image_circle
from recon.views.staying import SOFT, staying

WIDTH, BLUR = 320, 0.7
"""Width in pixels of the reduced pictures that are searched, and by how many of these they are blurred."""

STAYS = 0.25
"""Mean score of an edge, from -1 to 1, from which on it stays in place: in as many pictures of a street one edge in a thousand reaches
0.15."""

DOWN = 0.05
"""Sine of the angle below the horizon from which on what is seen is near enough to move."""

BROKEN, LOST, HIGHER = 0.5, 0.17, 0.1
"""What an outline must show of edges that stay where it goes at all; how much less in the mean; and how much more a line counts at the
picture's top than at its foot."""

STEEP, BEND, SMOOTH = 2, 0.5, 0.05
"""Rows that it may rise or fall from column to column, what each costs, and over which part of the width it is smoothed at the end."""

WIDE, MOST, RIM = 0.15, 0.4, 0.02
"""Of the picture's width that an outline must span, of the picture that may lie under it, and of the width by which it is raised."""


def with_ego_masks(log: Log, names: Sequence[str], width: int) -> Log:
    """The log, of whose cameras `names` know what of their pictures shows the car, is drawn over them or lies beyond the lens's image: by
    pictures `width` pixels wide where nobody says."""

    def told(camera: LogCamera) -> LogCamera:
        size = (width, round(width * camera.height / camera.width))
        found = not_the_street(log, camera, range(len(camera)), lambda i: camera.image(i, *size))
        masks = [at_size(mask, *size[::-1]).numpy() for mask in found.values()]
        return replace(camera, ego_mask=np.logical_or.reduce(masks) if masks else np.zeros((1, 1), bool))

    return replace(log, cameras={name: told(camera) if name in names else camera for name, camera in log.cameras.items()})


def not_the_street(log: Log, camera: LogCamera, indices: Sequence[int], picture: Callable[[int], np.ndarray]) -> dict[str, np.ndarray]:
    """Masks `[h, w]` of a camera's frames by what is said of them: the car (`ego_mask`), what is drawn over them (`drawn_over`), as data
    sets' are not, and what no light reaches (`image_circle`); those that there are, and the first alone where the camera says it."""
    picture, told = cache(picture), camera.ego_mask is not None
    drawn = None if told or log.sweeps else drawn_over(camera, indices, picture)
    found = {
        "the lowest part of its pictures, {}, shows the recording car itself": ego_mask(camera, indices, picture, drawn),
        "a part of its pictures, {}, is drawn over them": drawn,
        "the rim of its pictures, {}, lies beyond the lens's image": None if told else image_circle(camera, indices, picture),
    }
    return {said: mask for said, mask in found.items() if mask is not None}


def ego_mask(
    camera: LogCamera, indices: Sequence[int], picture: Callable[[int], np.ndarray], drawn: np.ndarray | None = None
) -> np.ndarray | None:
    """bool `[h, w]` of what shows the car in a camera's frames, about `WIDTH` pixels wide; None where nothing does. As the camera says,
    else by some of its frames `indices`, in order, uint8 `[H, W, 3]` of one size; it takes some tens of them while the car drives. `drawn`:
    what is drawn over them, whose edges do not count."""
    if camera.ego_mask is not None:
        return camera.ego_mask if camera.ego_mask.any() else None
    edges = staying(camera, indices, lambda i: picture(i).mean(-1, keepdims=True), WIDTH, BLUR, lambda rises: rises < -DOWN)
    if edges is None:
        return None
    if drawn is not None:  # and around it, where edges are told from what is soft
        edges[ndimage.binary_dilation(at_size(drawn, *edges.shape).numpy(), iterations=SOFT)] = 0
    return _outlined(edges)


def at_size(mask: np.ndarray, height: int, width: int) -> torch.Tensor:
    """A mask `[h, w]` for pictures of a size, bool `[height, width]`."""
    return F.interpolate(torch.from_numpy(mask)[None, None].float(), (height, width))[0, 0] > 0


def _outlined(edges: np.ndarray) -> np.ndarray | None:
    """The mask from how far edges stay, 0 to 1 `[h, w]`: all below the line from side to side that follows most of them, where it follows
    enough. Along the lowest row, where a bonnet narrower than the picture begins, it counts for nothing."""
    height, width = edges.shape
    worth = np.minimum(ndimage.maximum_filter1d(edges, 3, axis=0) / STAYS, 1) - BROKEN
    worth += HIGHER * np.arange(height)[::-1, None] / height
    worth[-1] = 0
    line = _best_line(worth)
    on = line < height - 1
    if on.sum() < WIDE * width or worth[line, np.arange(width)][on].mean() < 1 - BROKEN - LOST:
        return None
    line = ndimage.median_filter(line, 2 * round(SMOOTH * width / 2) + 1, mode="nearest")
    found = on & (np.arange(height)[:, None] >= line - round(RIM * width))
    return found if found.mean() <= MOST else None


def _best_line(worth: np.ndarray) -> np.ndarray:
    """Rows `[w]` of the line from the left to the right side of `worth` `[h, w]` whose sum is largest (dynamic programming)."""
    height, width = worth.shape
    rows, moves = np.arange(height), np.arange(-STEEP, STEEP + 1)
    total, came = worth[:, 0], np.zeros((width, height), dtype=np.int64)
    for x in range(1, width):
        beside = np.lib.stride_tricks.sliding_window_view(np.pad(total, STEEP, constant_values=-np.inf), len(moves))
        sums = beside - BEND * np.abs(moves)
        best = sums.argmax(1)
        came[x] = rows + moves[best]
        total = sums[rows, best] + worth[:, x]
    line = np.full(width, total.argmax())
    for x in range(width - 1, 0, -1):
        line[x - 1] = came[x][line[x]]
    return line
