"""How far edges stay where they are in a camera's pictures while the street moves through them.

Whatever the camera sees beside the car moves away from where the car goes to, nearer things faster. So an edge across that motion is
somewhere else in the next picture, but for edges of what rides along, or is drawn over the pictures; those along it, as of lane lines, say
nothing. What is far away stays as well, and a car ahead at the same speed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy import ndimage
from torch.nn import functional as F

from recon.log import LogCamera
from render.rays import camera_rays
from scenes.camera import Camera
from scenes.poses import inverse

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

STEP = 0.02
"""Of its distance, how far a point is moved to see which way it goes in the picture."""


def staying(
    camera: LogCamera,
    indices: Sequence[int],
    picture: Callable[[int], np.ndarray],
    width: int,
    blur: float,
    where: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray | None:
    """Mean score of edges, 0 where nothing stays to 1, float `[h, w]`, in those of a camera's frames `indices` that lie evenly along its
    way, about `width` pixels wide and blurred by so many pixels; None where it does not go far enough.

    picture: gives a frame's levels `[H, W, C]`, of whose channels that one counts that changes most at a place. where: picks what counts by
    the sine `[h, w]` of its angle above the horizon.
    """
    looks = _along_the_way(camera, list(indices))
    if len(looks) < FEWEST:
        return None
    total, seen = np.zeros((1, 1)), np.zeros((1, 1))
    for before, at, after in looks:
        small = _small(picture(at), width, blur)
        view = camera.camera(at, small.shape[1], small.shape[0])
        way, rises, known = _ways(view, camera.world_from_cam[after, :3, 3] - camera.world_from_cam[before, :3, 3])
        counts = where(rises) & known
        slope = np.stack([[ndimage.sobel(c, axis) / 8 for axis in (1, 0)] for c in np.moveaxis(small, 2, 0)]).transpose(2, 3, 0, 1)
        slope = slope - ndimage.uniform_filter(slope, (SOFT, SOFT, 0, 0))
        steep = np.linalg.norm(slope, axis=-1)
        most = steep.argmax(-1)[..., None]
        across = (np.take_along_axis(slope, most[..., None], 2)[:, :, 0] * way).sum(-1)
        total = total + np.where(counts, across / (np.abs(across) + ALONG * steep.max(-1) + FAINT), 0)
        seen = seen + counts
    return np.where(seen >= FEWEST, np.abs(total) / np.maximum(seen, 1), 0)


def _along_the_way(camera: LogCamera, indices: list[int]) -> list[tuple[int, int, int]]:
    """Places of pictures evenly along the way, each between the ones before and after it; none where the car stands or hardly moves."""
    at = camera.world_from_cam[indices, :3, 3]
    if len(indices) < FEWEST or (at - at[0]).norm(dim=1).max() < FARTHEST:
        return []
    way = at.diff(dim=0).norm(dim=1).cumsum(0).numpy()
    near = np.unique(np.searchsorted(way, np.linspace(0, way[-1], LOOKS + 2)[1:-1]) + 1)
    places = [i for i in near if i + 1 < len(indices) and (at[i + 1] - at[i - 1]).norm() >= APART]
    return [(indices[i - 1], indices[i], indices[i + 1]) for i in places]


def _small(picture: np.ndarray, width: int, blur: float) -> np.ndarray:
    """Levels `[h, w, C]` of a picture shrunk to a width."""
    levels = torch.from_numpy(picture.astype(np.float32)).movedim(2, 0)
    width = min(width, picture.shape[1])
    size = (round(len(picture) * width / picture.shape[1]), width)
    return ndimage.gaussian_filter(F.adaptive_avg_pool2d(levels, size).movedim(0, 2).numpy(), (blur, blur, 0))


def _ways(view: Camera, travel: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit directions `[h, w, 2]` in which what stands moves through the picture as the camera goes along `travel`, however far it is; the
    sine `[h, w]` of its angle above the horizon; and where the direction can be told, `[h, w]`."""
    rays = F.normalize(camera_rays(view).double(), dim=-1)
    ahead = F.normalize(inverse(view.world_from_cam)[:3, :3] @ travel, dim=0)
    motion = (view.lens.project(rays - STEP * ahead) - view.lens.project(rays)).numpy()
    length = np.linalg.norm(motion, axis=-1, keepdims=True)
    known = np.isfinite(length) & (length > 0)
    way = np.where(known, motion / np.where(known, length, 1), 0)
    return way, (rays @ view.world_from_cam[2, :3]).numpy(), known[..., 0]
