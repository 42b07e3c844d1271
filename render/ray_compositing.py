"""Compositing ray by ray, as `compositing` calls it: response "ray" and order "pixel", on the CPU."""

from __future__ import annotations

import torch

from render.kernels.composite_rays import composite_rays, composite_rays_gradient
from render.kernels.ray_rows import LISTS
from render.kernels.types import FRAME, TILE, Window, lanes
from render.launch import BANDS, run, view
from render.order import TileLists
from render.projected import Part, Projected
from render.settings import Settings

MOST_HELD = 1 << 19
"""Entries that the bands' working lists may hold together, at 400 bytes each."""


def lanes_of(planes: torch.Tensor):
    """Planes `[.., rows, pitch * 16]` as lane vectors."""
    return view(planes.view(*planes.shape[:-1], planes.shape[-1] // TILE, TILE), lanes)


def window_of(whole: torch.Tensor, w: Window, like: torch.Tensor, fill: tuple[float, ...]) -> torch.Tensor:
    """The window's planes `[C, rows, pitch]`, shaped as `like`, of the image's `[H, W, C]`; `fill` beyond its edge."""
    planes = like.new_empty(len(fill), *like.shape[1:]).copy_(like.new_tensor(fill)[:, None, None].expand(-1, *like.shape[1:]))
    inside = whole[w.top * TILE : (w.top + w.tiles_y) * TILE, w.left * TILE : (w.left + w.tiles_x) * TILE].permute(2, 0, 1)
    planes[:, : inside.shape[1], : inside.shape[2]] = inside
    return planes


def add_window(whole: torch.Tensor, w: Window, planes: torch.Tensor) -> None:
    """Write a window's planes back to the image's `[H, W, C]`."""
    inside = whole[w.top * TILE : (w.top + w.tiles_y) * TILE, w.left * TILE : (w.left + w.tiles_x) * TILE]
    inside += planes[:, : inside.shape[0], : inside.shape[1]].permute(1, 2, 0)


def draw_rays(settings: Settings, w: Window, lists: TileLists, scene: Projected, planes: torch.Tensor, picks: torch.Tensor) -> None:
    """Fill the window's planes and picks."""
    bands, column, working, reach = _working(lists)
    args = [view(lists.starts, int), view(lists.ids, int), *_scene(w, scene, planes), w, bands, settings.alpha_max, settings.termination]
    args += [column, view(working, lanes), view(reach, int), lanes_of(planes), lanes_of(picks)]
    run(composite_rays(settings.wanted, *_way(settings)), bands, args, planes.device)


def draw_rays_backward(
    settings: Settings, part: Part, lists: TileLists, scene: Projected, grads: torch.Tensor, slots: torch.Tensor,
    channel_slots: torch.Tensor,
) ->  tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    """Fill the gradient slots; return those of the canonical frames `[I, FRAME]`, and the rays' gradient as planes `[3, rows, pitch]`."""
    assert scene.frames is not None
    ray = settings.model.response == "ray"
    frame_slots = slots.new_empty(len(slots) if ray else 0, FRAME)
    g_rays = part.planes.new_zeros(3, *part.planes.shape[1:])
    bands, column, working, reach = _working(lists)
    args = [view(lists.starts, int), view(lists.ids, int), view(lists.slot_of, int), *_scene(part.window, scene, part.planes), part.window]
    args += [bands, settings.alpha_max, settings.termination, column, view(working, lanes), view(reach, int), view(working, float)]
    args += [lanes_of(part.planes), lanes_of(grads), view(slots, float), view(channel_slots, float), view(frame_slots, float)]
    run(composite_rays_gradient(settings.wanted, *_way(settings)), bands, [*args, lanes_of(g_rays)], slots.device)
    return frame_slots, g_rays


def _way(settings: Settings) -> tuple[bool, bool, int]:
    return settings.model.response == "ray", settings.config.order == "pixel", settings.squarings


def _scene(w: Window, scene: Projected, planes: torch.Tensor) -> list:
    assert scene.frames is not None and scene.rays is not None
    features = scene.records.new_empty(1, 1) if scene.features is None else scene.features
    rays = window_of(scene.rays, w, planes[:3], (0.0, 0.0, 1.0))
    return [view(scene.records, lanes), view(scene.frames, float), view(features, float), scene.channels, lanes_of(rays)]


def _working(lists: TileLists) -> tuple:
    """How many bands, the column ramp, and the bands' lists and reaches, as long as the longest tile list."""
    longest = max(1, int(lists.starts.diff().max()))
    bands = max(1, min(BANDS, MOST_HELD // longest))
    column = view(torch.arange(TILE, dtype=torch.float32)[None], lanes)
    return bands, column, torch.empty(bands, LISTS, longest, TILE), torch.empty(bands, 2, longest, dtype=torch.int32)
