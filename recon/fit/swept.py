"""Where something drove, nothing stands: splats that stand still before what moves may look like it from the recorded path, and are a ghost
from beside it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from recon.fit.model import Splats
from recon.log import Track
from recon.objects.curves import APART_US
from scenes.ground import Ground

CELL = 0.2
"""Side of a voxel, in metres: it belongs to what holds its middle."""

CLOSE = 0.2
"""Metres by which boxes may be too large, and too small."""

ABOVE = 0.3
"""Metres above a box's base, and above the ground, which a long box crosses on a slope, up to which a road may reach."""

STOOD = 8
"""Sweeps, of twice as many in a row, whose points in a column say that something stood there at another time: a car that waited before it
was found, or after it was lost. What only passes is seen there in fewer."""

SWEEP_US = 75_000
"""What begins within so much time is one sweep: of nuScenes' 20 a second, or of two lidars, what passes is seen in twice as many."""

LAYERS = 2**20
"""Voxels along each axis that keys tell apart: 200 km."""

POSES = 256
"""Of a box that are looked at together."""


@dataclass(frozen=True)
class Swept:
    """Voxels that boxes passed through: keys int64 `[K]`, rising."""

    keys: torch.Tensor

    @staticmethod
    def by(tracks: Sequence[Track], span_us: tuple[int, int], ground: Ground, static: np.ndarray, taken_us: np.ndarray) -> Swept:
        """What the boxes of moving `tracks` passed through within a span of time, but where those of the others stand, and where lidar's
        `static` points `[N, 3]`, of sweeps at these times int64 us `[N]`, show that something stood."""
        swept = _union(_voxels(_poses(t, span_us), t.size, -CLOSE, ABOVE) for t in tracks if t.moving)
        middles = (_cells(swept) + 0.5) * CELL
        swept = swept[middles[:, 2] > ground.height(torch.from_numpy(middles[:, :2])).numpy() + ABOVE]
        standing = _union(_voxels(t.world_from_box.numpy(), t.size, CLOSE, -CLOSE) for t in tracks if not t.moving)
        swept = np.setdiff1d(swept, standing, assume_unique=True)
        return Swept(torch.from_numpy(swept[~np.isin(swept // LAYERS, _stood(swept, static, _numbered(taken_us)))]))

    def to(self, device: torch.device | str) -> Swept:
        """The same on a device."""
        return Swept(self.keys.to(device))

    def holds(self, splats: Splats) -> torch.Tensor:
        """Mask `[N]` of the splats of the background that stand where boxes passed."""
        count = splats.sizes[0]
        mask = torch.zeros(len(splats), dtype=torch.bool, device=self.keys.device)
        if len(self.keys):
            x, y, z = (splats.fields["means"][:count].detach() / CELL).floor().long().unbind(1)
            keys = _keys(x, y, z)
            mask[:count] = self.keys[torch.searchsorted(self.keys, keys).clamp_max(len(self.keys) - 1)] == keys
        return mask


def _keys(x, y, z):
    """Numbers of cells by their places along the axes, int64, arrays or tensors: one a cell, and those of a column follow one another."""
    half = LAYERS // 2
    return ((x + half) * LAYERS + y + half) * LAYERS + z + half


def _cells(keys: np.ndarray) -> np.ndarray:
    """Places `[K, 3]` along the axes of cells by their numbers."""
    return np.stack([keys // LAYERS**2, keys // LAYERS % LAYERS, keys % LAYERS], 1) - LAYERS // 2


def _union(parts: Iterable[np.ndarray]) -> np.ndarray:
    """The numbers that are in any of the parts, rising."""
    return np.unique(np.concatenate([np.zeros(0, np.int64), *parts]))


def _poses(track: Track, span_us: tuple[int, int]) -> np.ndarray:
    """World from box `[P, 4, 4]`, on its way through a span of time, its ends a cell apart at most; not where it was not seen for long."""
    base, ahead = track.world_from_box[:, :3, 3], track.world_from_box[:, :3, 0] * float(track.size[0]) / 2
    # what turns on the spot moves its ends
    moved = torch.stack([base - ahead, base + ahead]).diff(dim=1).norm(dim=2).amax(0)
    steps = np.ceil(moved.numpy() / CELL).astype(int)
    gaps = np.diff(track.times_us)
    between = [
        np.linspace(time, time + gap, step, endpoint=False)[1:]
        for time, gap, step in zip(track.times_us, gaps, steps, strict=False)
        if gap <= APART_US and step > 1
    ]
    times = np.unique(np.concatenate([track.times_us, *between]).round().astype(np.int64))
    times = times[(times >= span_us[0]) & (times <= span_us[1])]
    return track.trajectory().at_each(torch.from_numpy(times)).numpy()


def _voxels(poses: np.ndarray, size: np.ndarray, more: float, above: float) -> np.ndarray:
    """Numbers of the voxels in a box `[length, width, height]`, grown by `more` metres, from `above` its base on, at any of its poses; its
    sides are taken to be upright."""
    half, top = size[:2] / 2 + more, size[2] + more
    if (half <= 0).any() or top <= above:
        return np.zeros(0, np.int64)
    reach = np.arange(-(around := int(np.ceil(np.hypot(*half) / CELL))), around + 1)
    columns = np.stack(np.meshgrid(reach, reach, indexing="ij"), -1).reshape(-1, 2)
    fewest = int((top - above) / CELL) - 1
    runs = []
    for some in np.split(poses, range(POSES, len(poses), POSES)):
        base, normal = some[:, :3, 3], some[:, :3, 2]
        cells = np.floor(base[:, None, :2] / CELL).astype(np.int64) + columns
        away = (cells + 0.5) * CELL - base[:, None, :2]
        rise = -(away @ normal[:, :2, None])[..., 0] / normal[:, 2:]  # of the base's plane
        local = away @ some[:, :2, :2] + rise[..., None] * some[:, None, 2, :2]
        inside = (np.abs(local) <= half).all(-1)
        floor = (rise + base[:, None, 2])[inside] / CELL - 0.5
        first, last = np.ceil(floor + above / CELL).astype(np.int64), np.floor(floor + top / CELL).astype(np.int64)
        # traffic passes through every column a hundred times: each run of voxels once, by its lowest, and whether it has one more
        x, y = cells[inside].T
        runs.append(np.unique(2 * _keys(x, y, first) + (last - first - fewest).clip(0, 1)))
    lowest, longer = np.divmod(_union(runs), 2)
    layers = np.arange(fewest + 2)
    return np.unique((lowest[:, None] + layers)[layers <= fewest + longer[:, None]])


def _numbered(taken_us: np.ndarray) -> np.ndarray:
    """Numbers `[N]`, rising with time, of the sweeps at these times, of which those within `SWEEP_US` are one."""
    began: list[int] = []
    for time in np.unique(taken_us).tolist():
        if not began or time - began[-1] >= SWEEP_US:
            began.append(time)
    return np.searchsorted(began, taken_us, side="right")


def _stood(swept: np.ndarray, static: np.ndarray, sweep: np.ndarray) -> np.ndarray:
    """Numbers of the columns, and of those beside them, in whose `swept` voxels points of `STOOD` sweeps soon after one another lie."""
    if not len(swept):
        return swept
    keys = _keys(*np.floor(static / CELL).astype(np.int64).T)
    there = swept[np.searchsorted(swept, keys).clip(max=len(swept) - 1)] == keys  # unlike `isin`, this sorts no points
    columns, sweeps = np.unique(np.stack([keys[there] // LAYERS, sweep[there]]), axis=1)
    last = np.arange(STOOD - 1, max(len(columns), STOOD - 1))
    first = last - (STOOD - 1)
    stood = (columns[first] == columns[last]) & (sweeps[last] - sweeps[first] < 2 * STOOD)
    beside = [x * LAYERS + y for x in (-1, 0, 1) for y in (-1, 0, 1)]
    return np.unique(columns[first][stood][:, None] + beside)
