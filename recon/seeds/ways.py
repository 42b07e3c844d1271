"""How unlike plates look where what they show may have gone from one to the next: normalised cross-correlation, by kernels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
import warp as wp

from recon.kernels.ways import Others, look_along, unlike_kernel
from recon.seeds.stereo import FLAT, UNSEEN, WINDOW, Plate, moments_of
from render.kernels.types import TILE, lanes
from render.launch import run, stage, view

NEAREST = 0.5
"""Metres before another picture from which on it may show a place."""


def at_rest(sides: Sequence[Sequence[tuple[Plate, int]]], count: int = 1) -> list[list[tuple[Plate, np.ndarray]]]:
    """Others and when they were taken, as `unlike` takes them for what stands still, at so many depths."""
    return [[(other, np.zeros((count, 3))) for other, _ in side] for side in sides]


def unlike(
    plate: Plate, sides: Sequence[Sequence[tuple[Plate, np.ndarray]]], rows: slice, depth: float | np.ndarray | torch.Tensor
) -> torch.Tensor:
    """1 - correlation `[N, rows, w]` of a plate's rows with others, of one size, where what they show has moved by any of N ways `[N, 3]`
    in the world; the mean of each side, of the better one, since the other may not see it. depth: z, one, or of each way `[N]`, or a tensor
    `[h, w]` of each pixel. All plates are on the host."""
    own = plate.grey[None, rows]
    (h, w), ways = own.shape[1:], len(sides[0][0][1])
    if isinstance(depth, torch.Tensor):
        closer, inverse = 1 / depth[rows].float(), np.ones(ways)
    else:
        closer, inverse = torch.ones(h, w), np.broadcast_to(1 / np.asarray(depth, np.float64), ways)
    flat = [(side, *of) for side, others in enumerate(sides) for of in others]
    first_row = np.array([[1, 0, 0], [0, 1, rows.indices(len(plate.grey))[0]], [0, 0, 1]])
    rays, back = np.linalg.inv(plate.pixels_from_cam()) @ first_row, np.linalg.inv(plate.cam_from_world)
    turns, gone = np.zeros((len(flat), 3, 3)), np.zeros((len(flat), 3, ways))
    for turn, go, (_, other, moved) in zip(turns, gone, flat, strict=True):
        there, pixels = other.cam_from_world @ back, other.pixels_from_cam()
        turn[:] = pixels @ there[:3, :3] @ rays
        go[:] = pixels @ (inverse * (other.cam_from_world[:3, :3] @ moved.T + there[:3, 3:]))
    others, chunks = Others(), -(-ways // TILE)
    others.turns, others.closer = wp.from_torch(torch.from_numpy(turns).float()), wp.from_torch(closer)
    others.gone, others.nearest = (_in_lanes(numbers, chunks) for numbers in (gone, NEAREST * inverse))
    others.sides = wp.from_torch(torch.tensor([side for side, *_ in flat], dtype=torch.int32))
    others.size = wp.vec2(*reversed(flat[0][1].grey.shape))
    greys = F.pad(torch.stack([other.grey for _, other, _ in flat]), (1, 2, 1, 2))
    with stage(own.device):
        return _compared(own, greys, others, chunks).movedim(-1, 1).flatten(0, 1)[:ways]


def _compared(own: torch.Tensor, greys: torch.Tensor, others: Others, chunks: int) -> torch.Tensor:
    """What ways cost `[chunks, h, w, TILE]` of a plate's grey levels `[1, h, w]` and others', as of `look_along`."""
    h, w = own.shape[1:]
    told = torch.cat([own, *moments_of(own)])
    shown, sums = torch.empty(len(greys), h, w, TILE), torch.empty(h, w + 2 * (WINDOW // 2), 5, TILE)
    cost = torch.empty(chunks, h, w, TILE)
    for chunk, costs in enumerate(cost):  # what a chunk needs stays in the cache; an item is a whole row, since squares share pixels
        run(look_along, len(greys) * h, [view(greys, float), others, chunk, view(shown, lanes), w], own.device)
        args = [view(told, float), view(shown, lanes), others, chunk, FLAT, UNSEEN, view(sums, lanes), view(costs, lanes), w]
        run(unlike_kernel(WINDOW // 2), h, args, own.device)
    return cost


def _in_lanes(numbers: np.ndarray, chunks: int) -> object:
    """`[..., N]` as lane vectors `[..., chunks]`, the last number again in lanes that are left over."""
    filled = torch.from_numpy(numbers[..., np.minimum(np.arange(chunks * TILE), numbers.shape[-1] - 1)])
    return wp.from_torch(filled.float().contiguous().unflatten(-1, (chunks, TILE)), dtype=lanes)
