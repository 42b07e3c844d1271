"""The arithmetic limit: how many lane operations compositing a preset takes, if nothing but them cost anything."""

from __future__ import annotations

from collections.abc import Callable

import torch

from render import RenderConfig
from render.compositing import _composite
from render.kernels.types import S_MAX, SLACK, TILE, Y_EXT, H, K, M, Wanted, X, Y
from render.launch import stage
from render.settings import Settings
from tests.bench.presets import Preset
from tests.render.test_cuda import Captured, keep_forward

OPERATIONS = 19
"""Of one row of one entry, forward, a multiplication with an addition as one: offset 1, exponent 1, exp 5 + 3, opacity 1, clamp 1, cutoff
1, weight 2, colours 3, transmittance 1."""


def kept_lists(preset: Preset) -> tuple[Settings, Captured]:
    """What a forward pass of a preset of one instance left, its tile lists among it."""
    (placed,), camera = preset.placed, preset.camera
    settings = Settings(camera.width, camera.height, preset.model, RenderConfig(), Wanted(), (0,), gradients=False)
    kept, _ = keep_forward(settings, placed.gaussians, torch.linalg.inv(camera.world_from_cam) @ placed.world_from_local, camera.lens)
    return settings, kept


def compositing(preset: Preset) -> Callable[[], object]:
    """Compositing alone, from lists that are made."""
    settings, kept = kept_lists(preset)
    (part,) = kept.parts

    def work() -> object:
        with stage(torch.device("cpu")):
            return _composite(settings, part.window, part.lists, kept.scene)

    return work


def forward_limit(preset: Preset) -> float:
    """Lane operations of a forward composite of a preset of one instance, without termination."""
    settings, kept = kept_lists(preset)
    lists = kept.parts[0].lists
    total = int(lists.starts[-1])
    tile = torch.repeat_interleave(torch.arange(len(lists.starts) - 1), lists.starts.diff().long())
    return OPERATIONS * float(rows_of(kept.scene.records[lists.ids[:total].long()].double(), tile, settings.tiles_x).sum())


def rows_of(r: torch.Tensor, tile: torch.Tensor, tiles_x: int) -> torch.Tensor:
    """Rows of its tile that each entry's ellipse reaches: `row_range` of the composite kernels, in float64."""
    px = r[:, int(X)] - (tile % tiles_x * TILE + 0.5)
    py = r[:, int(Y)] - (tile // tiles_x * TILE + 0.5)
    k2, m, h, slack = r[:, int(K)].square(), r[:, int(M)], r[:, int(H)], float(SLACK)
    inv_c = 1 / (k2 * m * m + h)
    cs, slope, furthest = r[:, int(S_MAX)] / inv_c, k2 * m * inv_c, m * r[:, int(Y_EXT)]
    reach = []
    for sign in (1, -1):
        dx = (sign * furthest).clamp(-px - slack, TILE - 1 - px + slack)
        reach.append(py + slope * dx + sign * ((cs - k2 * h * dx * dx).clamp_min(0).sqrt() * inv_c + slack))
    low, high = reach
    return (low.floor().clamp_max(TILE - 1) - high.ceil().clamp_min(0) + 1).clamp_min(0)
