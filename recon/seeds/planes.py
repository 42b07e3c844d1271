"""How far away everything in a picture is, as pictures of the same place from elsewhere tell it.

Plane sweep (Collins 1996) in the directions of a street's surfaces (Gallup et al. 2007): by planes that face the picture, that lie as the
road does, and that stand as walls along the way. Each pixel takes the direction whose planes suit it and its neighbours best, smoothed
along scanlines by semi-global matching (Hirschmüller 2008), where staying on a plane costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from recon.seeds.stereo import UNSEEN, WINDOW, Plate, compared, moments_of

PLANES = 96
"""Planes of a direction, in equal steps of inverse distance from 0 (the sky) on."""

CHUNK = 16
"""Planes that are looked at together: what they need stays in the cache."""

LEANING = 7
"""Side of the squares that are correlated on the road and on walls. What faces the picture is smaller than the squares of such surfaces may
be, and on these, seen askance, smaller ones hold too little."""

ASKANCE = 0.3
"""Part of the largest cosine between a direction's planes and rays from which on these are compared: others hardly meet the planes."""

ABOVE = 1.4
"""Times as far below the eye as the road at most, planes that lie as the road does may be."""

NUDGE, JUMP = 0.06, 0.5
"""What it costs a pixel to be one plane off its neighbour, or any number; a correlation of 1 costs 0, of none 1."""

EDGE = 12.0
"""Levels between neighbours at which a jump costs half."""

PINNED = 1.0
"""What it costs the pixel of a known point to be elsewhere."""

UNDERGROUND, ON_LIMIT = 2.0, 0.25
"""What it costs to be under the ground, and how many planes above the limit nothing is believed."""

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
    found = [_along(direction, plate, others, 1 / nearest, points, limit) for direction in _directions(plate, others, limit)]
    costs, inverse_depths = (torch.stack(maps) for maps in zip(*found, strict=True))
    return (1 / inverse_depths.gather(0, costs.argmin(0, keepdim=True))[0]).numpy()


def _directions(plate: Plate, others: list[Plate], limit: torch.Tensor) -> list[Direction]:
    """Those of what faces the plate, of the road, where its inverse depth `limit` is known, and of walls along the way to the others."""
    rays, turn, up = plate.rays(), plate.cam_from_world[:3, :3], np.array([0.0, 0.0, 1.0])
    found = [Direction(torch.ones_like(plate.grey))]
    if limit.any():
        found.append(Direction((rays @ torch.from_numpy(turn @ -up).float()).clamp_min(0), LEANING, ABOVE))
    way = max((other.eye() - plate.eye() for other in others), key=lambda way: float(np.linalg.norm(way)))
    across = np.cross(up, way)
    if across.any():
        found.append(Direction((rays @ torch.from_numpy(turn @ across / np.linalg.norm(across)).float()).abs(), LEANING))
    return found


def _along(
    direction: Direction, plate: Plate, others: list[Plate], largest: float, points: np.ndarray, limit: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """What the best of a direction's planes costs each pixel, and the inverse depth there, at most about `largest`, NaN where others do not
    tell it, `[h, w]` each."""
    steepest = float(direction.slope.max())
    step = direction.slope * (largest / max(steepest, 1e-6) / (PLANES - 1))
    planes = torch.arange(PLANES)
    cost = _costs(plate, others, planes[:, None, None] * step, direction.window)
    nowhere = cost == UNSEEN
    _pin(cost, plate, points, step)
    floor = (limit / step.clamp_min(1e-9))[..., None]
    cost += UNDERGROUND * ((planes < floor - 1.0) | (planes > direction.above * floor))
    askance = direction.slope < ASKANCE * steepest
    cost[askance] = UNSEEN
    cost = _smoothed(cost, plate.grey)
    least, best = cost.min(2)
    middle = best.clamp(1, PLANES - 2)
    before, here, after = (cost.gather(2, (middle + d)[..., None])[..., 0] for d in (-1, 0, 1))
    bend = (before + after - 2 * here).clamp_min(1e-6)
    between = torch.where(best == middle, middle + (0.5 * (before - after) / bend).clamp(-0.5, 0.5), best.float())
    # what would rather be under the ground lies on the limit in all pictures, and what moves with the camera seems infinitely far in all
    known = ~nowhere.gather(2, best[..., None])[..., 0] & (between > floor[..., 0] + ON_LIMIT) & (between > BEYOND)
    return torch.where(askance, torch.inf, least), torch.where(known, between * step, torch.nan)


def _costs(plate: Plate, others: list[Plate], inverse_depths: torch.Tensor, window: int) -> torch.Tensor:
    """1 - correlation `[h, w, D]`, in squares of a side, at inverse depths `[D, h, w]`, the mean of the better half of the others (they may
    not see the place); `UNSEEN` where none shows it."""
    h, w = plate.grey.shape
    rays = plate.rays().contiguous()
    motions = [torch.from_numpy(other.cam_from_world @ np.linalg.inv(plate.cam_from_world)).float() for other in others]
    rays_there = [(rays @ motion[:3, :3].T).movedim(2, 0) for motion in motions]
    moments = moments_of(plate.grey[None], window)
    costs = torch.empty(h, w, len(inverse_depths))
    for k, part in enumerate(inverse_depths.split(CHUNK)):
        best = second = torch.full((len(part), h, w), 2.0)
        for other, motion, turned in zip(others, motions, rays_there, strict=True):
            x, y, z = (turned[axis] + part * motion[axis, 3] for axis in range(3))
            cost, inside = compared(plate.grey, moments, other, x, y, z, window)
            cost = torch.where(inside & (z > 0.1 * part), cost, UNSEEN)
            second = torch.minimum(second, torch.maximum(cost, best))
            best = torch.minimum(cost, best)
        costs[..., CHUNK * k : CHUNK * k + len(part)] = (best if len(others) < 3 else (best + second) / 2).permute(1, 2, 0)
    return costs


def _pin(cost: torch.Tensor, plate: Plate, points: np.ndarray, step: torch.Tensor) -> None:
    """Make the pixels of known points expensive everywhere else; of several in one pixel the last counts. step: inverse depth `[h, w]` from
    plane to plane."""
    row, column, z, inside = plate.shown(points)
    place = torch.from_numpy(1 / z[inside] / step.clamp_min(1e-9).numpy()[row[inside], column[inside]]).float()
    away = (torch.arange(PLANES) - place[:, None]).abs()
    # NumPy's, since torch's threads write in any order, and which point counts would be left to chance
    cost.numpy()[row[inside], column[inside]] += (PINNED * (away / 2).clamp_max(1.0)).numpy()


def _smoothed(cost: torch.Tensor, grey: torch.Tensor) -> torch.Tensor:
    """Costs `[h, w, D]` summed along paths from the left, right, top and bottom (Hirschmüller 2008, equation 13)."""
    total = torch.zeros_like(cost)
    for axis in (0, 1):
        lines, sums = cost.movedim(axis, 0), total.movedim(axis, 0)
        jumps = JUMP / (1 + grey.movedim(axis, 0).diff(dim=0).abs() / EDGE)
        for order, edges in ((range(len(lines)), jumps), (range(len(lines) - 1, -1, -1), jumps.flip(0))):
            path = torch.zeros_like(lines[0])
            # the first line has nothing before it: its jump costs nothing
            for i, jump in zip(order, [edges[0] * 0, *edges], strict=True):
                least = path.amin(1, keepdim=True)
                reach = torch.minimum(path, jump[:, None] + least)
                reach[:, 1:] = torch.minimum(reach[:, 1:], path[:, :-1] + NUDGE)
                reach[:, :-1] = torch.minimum(reach[:, :-1], path[:, 1:] + NUDGE)
                path = lines[i] + (reach - least)
                sums[i] += path
    return total
