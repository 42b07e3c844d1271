"""Compositing by blocks of threads, as `compositing` calls it on CUDA: every response and order, forward and back."""

from __future__ import annotations

import torch
import warp as wp

from render.kernels.canonical import FRAME
from render.kernels.composite_cuda import composite_blocks, composite_blocks_gradient
from render.kernels.composite_cuda_order import MOST_SPLATS, order_blocks, order_blocks_gradient
from render.kernels.types import TILE, Window
from render.launch import run_blocks, view
from render.order import TileLists
from render.projected import Part, Projected
from render.ray_compositing import settled_tiles
from render.settings import Settings

BLOCKS = 264
"""Blocks of the backward pass by pixel, two for each multiprocessor of a large card."""

SEGMENT = 512
"""Entries whose weights such a block holds at once: 1 MiB."""


def draw_blocks(
    settings: Settings, w: Window, lists: TileLists, scene: Projected, planes: torch.Tensor, picks: torch.Tensor, tile: int = TILE
) -> tuple[torch.Tensor, ...]:
    """Fill the window's planes and picks; returns where compositing ended: one past each pixel's last entry, or, by pixel, which tiles are
    settled and the key of each pixel's last entry. tile: pixels of its side; with one the CPU can run this."""
    args = [view(lists.starts, int), view(lists.ids, int), *_scene(scene), w, settings.alpha_max, settings.termination]
    args += [view(planes, float), view(picks, float)]
    if _ordered(settings):
        if len(scene.records) > MOST_SPLATS:
            raise ValueError(f'order "pixel" on CUDA draws at most {MOST_SPLATS} splats, got {len(scene.records)}; use order "tile"')
        settled = settled_tiles(settings, w, lists, scene, tile)
        last = _ends(planes, torch.int64)
        args += [view(settled, int), view(last, wp.int64)]
        run_blocks(order_blocks(*_way(settings, tile)), w.tiles_x * w.tiles_y, tile * tile, args, planes.device)
        return settled, last
    last = _ends(planes, torch.int32)
    run_blocks(composite_blocks(*_way(settings, tile)), w.tiles_x * w.tiles_y, tile * tile, [*args, view(last, int)], planes.device)
    return (last,)


def draw_blocks_backward(
    settings: Settings, part: Part, lists: TileLists, scene: Projected, grads: torch.Tensor, slots: torch.Tensor,
    channel_slots: torch.Tensor, g_rays: torch.Tensor | None, tile: int = TILE,
) -> torch.Tensor:  # fmt: skip
    """Fill the gradient slots of the window's entries and add to the rays' gradient `[G, C, H, W]`; returns the slots of the canonical
    frames `[I, FRAME]`, none where the response is "conic"."""
    ray, w, device = settings.model.response == "ray", part.window, slots.device
    frame_slots = slots.new_zeros(len(slots) if ray else 0, FRAME)
    args = [view(lists.starts, int), view(lists.ids, int), view(lists.slot_of, int), *_scene(scene), w, settings.alpha_max]
    args += [view(part.planes, float), view(grads, float)]
    filled = [view(slots, float), view(channel_slots, float), view(frame_slots, float), view(_or_none(g_rays, 4), wp.float64)]
    if _ordered(settings):
        blocks = min(BLOCKS, w.tiles_x * w.tiles_y)
        pushes = torch.empty(blocks, SEGMENT, tile * tile, 2, dtype=torch.float32, device=device)
        told = [view(part.ends[0], int), view(part.ends[1], wp.int64), blocks, view(pushes, wp.vec2)]
        run_blocks(order_blocks_gradient(*_way(settings, tile)), blocks, tile * tile, [*args, *told, *filled], device)
    else:
        kernel = composite_blocks_gradient(*_way(settings, tile))
        run_blocks(kernel, w.tiles_x * w.tiles_y, tile * tile, [*args, view(part.ends[0], int), *filled], device)
    return frame_slots


def _ordered(settings: Settings) -> bool:
    return settings.config.order == "pixel"


def _way(settings: Settings, tile: int) -> tuple:
    return settings.wanted, settings.model.response == "ray", settings.eyes, tile


def _ends(planes: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    return torch.empty(planes.shape[1:], dtype=dtype, device=planes.device)


def _scene(scene: Projected) -> list:
    features = scene.records.new_empty(1, 1) if scene.features is None else scene.features
    frames, rays = _or_none(scene.frames, 2), _or_none(scene.rays, 4)
    seen = [view(scene.records, float), view(frames, wp.float64), view(rays, wp.float64), view(scene.slopes, wp.vec2)]
    return [*seen, view(features, float), scene.channels]


def _or_none(tensor: torch.Tensor | None, dimensions: int) -> torch.Tensor:
    """The tensor, or, for a kernel that will not read it, an empty one."""
    return torch.empty([0] * dimensions, dtype=torch.float64) if tensor is None else tensor
