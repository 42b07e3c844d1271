"""How far away everything in a picture is, as pictures of the same place from elsewhere tell it.

Plane sweep (Collins 1996) in the directions of a street's surfaces (Gallup et al. 2007): by planes that face the picture, that lie as the
road does, and that stand as walls along the way. Each pixel takes the direction whose planes suit it and its neighbours best, smoothed
along scanlines by semi-global matching (Hirschmüller 2008), where staying on a plane costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from recon.kernels.planes import PLANES
from recon.seeds.stereo import WINDOW, Plate
from recon.seeds.volume import Volume

LEANING = 7
"""Side of the squares that are correlated on the road and on walls. What faces the picture is smaller than the squares of such surfaces may
be, and on these, seen askance, smaller ones hold too little."""

ASKANCE = 0.3
"""Part of the largest cosine between a direction's planes and rays from which on these are compared: others hardly meet the planes."""

ABOVE = 1.4
"""How many times nearer below the eye than the road is, planes that lie as it does may be at most."""

ON_LIMIT = 0.25
"""How many planes above the ground nothing is believed."""

BEYOND = 0.5
"""Planes up to which things are too far to be told from what moves with the camera."""


@dataclass(frozen=True)
class Direction:
    """Parallel planes before a plate: `slope` `[h, w]`, what the inverse depth z of its pixels is times a plane's inverse distance; side of
    the squares that are compared on them; how many times nearer than the ground they may be."""

    slope: torch.Tensor
    window: int = WINDOW
    above: float = np.inf


def swept(plate: Plate, others: list[Plate], nearest: float, points: np.ndarray, deepest: np.ndarray) -> np.ndarray:
    """Depth z `[h, w]` of a plate's pixels as `others`, of its size, tell it; NaN where they do not.

    nearest: metres to the nearest depth that is tried; points: world points `[N, 3]` that it is known to show; deepest: depth `[h, w]` of
    the ground, infinite above the horizon.
    """
    limit = torch.from_numpy(1 / deepest).float()
    volume, known = Volume(plate, others), _known(plate, points)
    found = [_along(direction, volume, 1 / nearest, known, limit) for direction in _directions(plate, others, limit)]
    costs, inverse_depths = (torch.stack(maps) for maps in zip(*found, strict=True))
    return (1 / inverse_depths.gather(0, costs.argmin(0, keepdim=True))[0]).numpy()


def _directions(plate: Plate, others: list[Plate], limit: torch.Tensor) -> list[Direction]:
    """Those of what faces the plate, of the road, where its inverse depth `limit` is known, and of walls along the way to the others."""
    rays, turn, up = plate.rays(), plate.cam_from_world[:3, :3], np.array([0.0, 0.0, 1.0])
    found = [Direction(torch.ones(plate.grey.shape))]
    if limit.any():
        found.append(Direction((rays @ torch.from_numpy(turn @ -up).float()).clamp_min(0), LEANING, ABOVE))
    way = max((other.eye() - plate.eye() for other in others), key=lambda way: float(np.linalg.norm(way)))
    across = np.cross(up, way)
    if across.any():
        found.append(Direction((rays @ torch.from_numpy(turn @ across / np.linalg.norm(across)).float()).abs(), LEANING))
    return found


def _along(
    direction: Direction, volume: Volume, largest: float, known: torch.Tensor, limit: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """What the best of a direction's planes costs each pixel, and the inverse depth there, at most about `largest`, NaN where others do not
    tell it, `[h, w]` each."""
    steepest = float(direction.slope.max())
    step = direction.slope * (largest / max(steepest, 1e-6) / (PLANES - 1))
    floor = limit / step.clamp_min(1e-9)
    bounds = torch.stack([floor - 1, (direction.above * floor).nan_to_num(torch.inf)])
    askance = direction.slope < ASKANCE * steepest
    bounds[:, askance] = torch.nan
    # what would rather be under the ground lies on the limit in all pictures, and what moves with the camera seems infinitely far in all
    lowest = (floor + ON_LIMIT).clamp_min(BEYOND)
    return volume.best(step, bounds, known.where(~askance, torch.nan), lowest, direction.window)


def _known(plate: Plate, points: np.ndarray) -> torch.Tensor:
    """Inverse depths `[h, w]` of the pixels of points, NaN in all others; of several in one pixel the last counts."""
    row, column, z, inside = plate.shown(points)
    # NumPy's, since torch's threads write in any order, and which point counts would be left to chance
    known = np.full(plate.grey.shape, np.nan, np.float32)
    known[row[inside], column[inside]] = 1 / z[inside]
    return torch.from_numpy(known)
