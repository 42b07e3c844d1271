"""The arithmetic limit: how many lane operations compositing a preset takes, if nothing but them cost anything."""

from __future__ import annotations

import torch

from render import RenderConfig
from render.kernels.types import INV_C, S_MAX, SLACK, TILE, Y_EXT, H, K, M, Wanted, X, Y
from render.settings import Settings
from tests.bench.presets import Preset
from tests.render.test_cuda import keep_forward

OPERATIONS = 23
"""Of one row of one entry, forward: offset 1, exponent 2, exp 7 + 3, alpha 2, cutoff 3, weight 2, colours 3."""


def forward_limit(preset: Preset) -> float:
    """Lane operations of a forward composite of a preset of one instance, without termination."""
    (placed,), camera = preset.placed, preset.camera
    settings = Settings(camera.width, camera.height, preset.model, RenderConfig(), Wanted(), (0,))
    pose = torch.linalg.inv(camera.world_from_cam) @ placed.world_from_local
    kept, _ = keep_forward(settings, placed.gaussians, pose, camera.lens)
    lists = kept.parts[0].lists
    total = int(lists.starts[-1])
    tile = torch.repeat_interleave(torch.arange(len(lists.starts) - 1), lists.starts.diff().long())
    return OPERATIONS * float(rows_of(kept.scene.records[lists.ids[:total].long()].double(), tile, settings.tiles_x).sum())


def rows_of(r: torch.Tensor, tile: torch.Tensor, tiles_x: int) -> torch.Tensor:
    """Rows of its tile that each entry's ellipse reaches: `row_range` of the composite kernels, in float64."""
    px = r[:, int(X)] - (tile % tiles_x * TILE + 0.5)
    py = r[:, int(Y)] - (tile // tiles_x * TILE + 0.5)
    k2, m, h, inv_c, slack = r[:, int(K)].square(), r[:, int(M)], r[:, int(H)], r[:, int(INV_C)], float(SLACK)
    cs, slope, furthest = (k2 * m * m + h) * r[:, int(S_MAX)], k2 * m * inv_c, m * r[:, int(Y_EXT)]
    reach = []
    for sign in (1, -1):
        dx = (sign * furthest).clamp(-px - slack, TILE - 1 - px + slack)
        reach.append(py + slope * dx + sign * ((cs - k2 * h * dx * dx).clamp_min(0).sqrt() * inv_c + slack))
    low, high = reach
    return (low.floor().clamp_max(TILE - 1) - high.ceil().clamp_min(0) + 1).clamp_min(0)
