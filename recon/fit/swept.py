"""Where something drove, nothing stands: splats that stand still before what moves may look like it from the recorded path, and are a ghost
from beside it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from recon.actors import APART_US
from recon.fit.model import Splats
from recon.log import Track
from scenes.ground import Ground

CELL = 0.25
"""Side of a cell of the ground, in metres."""

WITHIN, ABOVE = 0.2, 0.3
"""Metres that boxes may be too long, wide and high; and above their base, and above the ground, which a long box crosses on a slope, up to
which a road may reach."""


class Swept:
    """What boxes passed through.

    keys: of the ground's cells, int64 `[K]`, rising; low, high `[K]`: between which heights, in metres, boxes passed over them
    """

    def __init__(self, tracks: Sequence[Track], ground: Ground, device: torch.device | str):
        each = [_cells(_passed(track), ground) for track in tracks]  # one by one: traffic passes over every cell a thousand times
        nothing = (np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
        keys, low, high = _spans(*(np.concatenate(parts) for parts in zip(nothing, *each, strict=True)))
        self.keys = torch.from_numpy(keys).to(device)
        self.low, self.high = (torch.from_numpy(z).float().to(device) for z in (low, high))

    def holds(self, splats: Splats) -> torch.Tensor:
        """Mask `[N]` of the splats of the background that stand where boxes passed."""
        count = splats.sizes[0]
        mask = torch.zeros(len(splats), dtype=torch.bool, device=self.keys.device)
        if not len(self.keys):
            return mask
        means = splats.fields["means"][:count].detach()
        keys = _keys(means[:, :2])
        cell = torch.searchsorted(self.keys, keys).clamp_max(len(self.keys) - 1)
        mask[:count] = (self.keys[cell] == keys) & (means[:, 2] > self.low[cell]) & (means[:, 2] < self.high[cell])
        return mask


def _cells(passed: np.ndarray, ground: Ground) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of places `[M, 4]` that a box passed over: cells, and from and up to which height nothing stands there, `[K]` each."""
    xy = torch.from_numpy(passed[:, :2])
    return _spans(_keys(xy).numpy(), np.maximum(passed[:, 2], ground.height(xy).numpy() + ABOVE), passed[:, 3])


def _spans(keys: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each key once, rising, with the least and the greatest height that it comes with."""
    once, place = np.unique(keys, return_inverse=True)
    least, greatest = np.full(len(once), np.inf), np.full(len(once), -np.inf)
    np.minimum.at(least, place, low)
    np.maximum.at(greatest, place, high)
    return once, least, greatest


def _keys(xy: torch.Tensor) -> torch.Tensor:
    """Numbers int64 `[N]` of the cells in which places `[N, 2]` are."""
    cell = (xy / CELL).floor().long()
    return cell[:, 0] * 2**32 + cell[:, 1]


def _passed(track: Track) -> np.ndarray:
    """Places `[M, 4]` that a box passed over, less than a cell apart: x, y, and from and up to which height nothing stands there."""
    half, top = track.size[:2] / 2 - WITHIN, track.size[2] - WITHIN
    if (half <= 0).any() or top <= ABOVE:
        return np.zeros((0, 4))
    steps = np.ceil(track.world_from_box[:, :2, 3].diff(dim=0).norm(dim=1).numpy() / (CELL / 2)).astype(int)
    gaps = np.diff(track.times_us)
    between = [
        np.linspace(time, time + gap, step, endpoint=False)[1:]
        for time, gap, step in zip(track.times_us, gaps, steps, strict=False)
        if gap <= APART_US and step > 1
    ]
    times = np.unique(np.concatenate([track.times_us, *between]).round().astype(np.int64))
    poses = track.trajectory().at_each(torch.from_numpy(times)).numpy()
    x, y = (np.linspace(-h, h, int(np.ceil(4 * h / CELL)) + 1) for h in half)
    floor = np.stack(np.meshgrid(x, y, [0.0], indexing="ij"), -1).reshape(-1, 3)
    world = (floor @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]).reshape(-1, 3)
    return np.concatenate([world, world[:, 2:]], 1) + [0, 0, ABOVE, top]
