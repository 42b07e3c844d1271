"""Where a camera's pictures show the recording car itself: its bonnet stays where it is while the street moves through the picture.

Whatever the camera sees beside the car moves away from where the car goes to, nearer things faster. So an edge across that motion is
somewhere else in the next picture, but for edges of what rides along; those along it, as of lane lines, say nothing. What is far away
stays as well, and a car ahead at the same speed: the mask has what stays below the horizon and reaches down to the picture's edge.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage
from torch.nn import functional as F

from recon.log import Log, LogCamera
from render.rays import camera_rays
from scenes.camera import Camera
from scenes.poses import inverse

WIDTH = 320
"""Width in pixels of the reduced pictures that are searched."""

LOOKS, FEWEST = 48, 12
"""Pictures that are searched, evenly along the way, and how many are needed."""

APART, FARTHEST = 0.1, 3.0
"""Metres needed between the pictures before and after each, and from the first picture to the farthest: while a car stands, its poses
jitter by millimetres, and its street stays in place as its bonnet does."""

FAINT, ALONG = 2.0, 0.25
"""Levels a pixel below which an edge counts less, as those of dust and reflections in a windscreen; and the part of an edge across the
motion below which it counts less, as that of a lane line, along which the car does not quite drive."""

SOFT = 9
"""Pixels over which a change of brightness is no edge: in the car's own headlights the road is brighter near by."""

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

STEP = 0.02
"""Of its distance, how far a point is moved to see which way it goes in the picture."""


def with_ego_masks(log: Log, names: Sequence[str], width: int) -> Log:
    """The log, of whose cameras `names` know what of their pictures shows the car: by pictures `width` pixels wide where nobody says."""

    def told(camera: LogCamera) -> LogCamera:
        size = (width, round(width * camera.height / camera.width))
        found = ego_mask(camera, range(len(camera)), lambda i: camera.image(i, *size))
        return replace(camera, ego_mask=np.zeros((1, 1), bool) if found is None else found)

    return replace(log, cameras={name: told(camera) if name in names else camera for name, camera in log.cameras.items()})


def ego_mask(camera: LogCamera, indices: Sequence[int], picture: Callable[[int], np.ndarray]) -> np.ndarray | None:
    """bool `[h, w]` of what shows the car in a camera's frames, about `WIDTH` pixels wide; None where nothing does. As the camera says,
    else by some of its frames `indices`, in order, uint8 `[H, W, 3]` of one size; it takes some tens of them while the car drives."""
    if camera.ego_mask is not None:
        return camera.ego_mask if camera.ego_mask.any() else None
    looks = _along_the_way(camera, list(indices))
    if len(looks) < FEWEST:
        return None
    total, seen = np.zeros((1, 1)), np.zeros((1, 1))
    for before, at, after in looks:
        small = _small(picture(at))
        view = camera.camera(at, small.shape[1], small.shape[0])
        way, below = _ways(view, camera.world_from_cam[after, :3, 3] - camera.world_from_cam[before, :3, 3])
        slope = np.stack([ndimage.sobel(small, 1), ndimage.sobel(small, 0)], -1) / 8
        slope -= ndimage.uniform_filter(slope, (SOFT, SOFT, 0))
        across = (slope * way).sum(-1)
        total = total + np.where(below, across / (np.abs(across) + ALONG * np.linalg.norm(slope, axis=-1) + FAINT), 0)
        seen = seen + below
    return _outlined(np.where(seen >= FEWEST, np.abs(total) / np.maximum(seen, 1), 0))


def at_size(mask: np.ndarray, height: int, width: int) -> torch.Tensor:
    """A mask `[h, w]` for pictures of a size, bool `[height, width]`."""
    return F.interpolate(torch.from_numpy(mask)[None, None].float(), (height, width))[0, 0] > 0


def _along_the_way(camera: LogCamera, indices: list[int]) -> list[tuple[int, int, int]]:
    """Places of pictures evenly along the way, each between the ones before and after it; none where the car stands or hardly moves."""
    at = camera.world_from_cam[indices, :3, 3]
    if len(indices) < FEWEST or (at - at[0]).norm(dim=1).max() < FARTHEST:
        return []
    way = at.diff(dim=0).norm(dim=1).cumsum(0).numpy()
    near = np.unique(np.searchsorted(way, np.linspace(0, way[-1], LOOKS + 2)[1:-1]) + 1)
    places = [i for i in near if i + 1 < len(indices) and (at[i + 1] - at[i - 1]).norm() >= APART]
    return [(indices[i - 1], indices[i], indices[i + 1]) for i in places]


def _small(picture: np.ndarray) -> np.ndarray:
    """Levels `[h, w]` of a picture shrunk to `WIDTH`."""
    grey = torch.from_numpy(picture.mean(-1, dtype=np.float32))
    width = min(WIDTH, picture.shape[1])
    size = (round(len(picture) * width / picture.shape[1]), width)
    return ndimage.gaussian_filter(F.adaptive_avg_pool2d(grey[None], size)[0].numpy(), 0.7)


def _ways(view: Camera, travel: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions `[h, w, 2]` in which what stands moves through the picture as the camera goes along `travel`, however far it is, and
    whether it lies `DOWN` below the horizon, `[h, w]`. Nowhere and nothing where that cannot be told."""
    rays = F.normalize(camera_rays(view).double(), dim=-1)
    ahead = F.normalize(inverse(view.world_from_cam)[:3, :3] @ travel, dim=0)
    motion = (view.lens.project(rays - STEP * ahead) - view.lens.project(rays)).numpy()
    length = np.linalg.norm(motion, axis=-1, keepdims=True)
    known = np.isfinite(length) & (length > 0)
    way = np.where(known, motion / np.where(known, length, 1), 0)
    falls = (rays @ view.world_from_cam[2, :3]).numpy() < -DOWN
    return way, falls & known[..., 0]


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
