"""Compositing ray by ray, as `compositing` calls it: response "ray" and order "pixel", on the CPU."""

from __future__ import annotations

import torch
import warp as wp

from render.kept import kept_beside
from render.kernels.canonical import FRAME
from render.kernels.composite_rays import SUMS, composite_rays, composite_rays_gradient
from render.kernels.ray_rows import LISTS, lanes64
from render.kernels.settled import settle
from render.kernels.types import TILE, Window, lanes
from render.launch import BANDS, run, view
from render.order import TileLists
from render.projected import Part, Projected
from render.settings import Settings

MOST_HELD = 1 << 19
"""Entries that the bands' working lists may hold together, at 640 bytes each."""


def lanes_of(planes: torch.Tensor):
    """Planes `[.., rows, pitch * 16]` as lane vectors."""
    return view(planes.view(*planes.shape[:-1], planes.shape[-1] // TILE, TILE), lanes64 if planes.dtype == torch.float64 else lanes)


def settled_tiles(settings: Settings, w: Window, lists: TileLists, scene: Projected, tile: int = TILE) -> torch.Tensor:
    """int32 `[tiles]`: 1 where the tile's order is proven to be each pixel's own. tile: pixels of its side."""
    settled = torch.zeros(w.tiles_x * w.tiles_y, dtype=torch.int32, device=scene.records.device)
    if settings.config.order == "pixel" and settings.model.response == "conic":
        assert scene.frames is not None and scene.rays is not None
        args = [view(lists.starts, int), view(lists.ids, int), view(scene.frames, wp.float64)]
        args += [view(extent, wp.float64) for extent in _extent(scene.rays, tile)]
        run(settle, len(settled), [*args, int(settings.eyes), w, view(settled, int)], settled.device)
    return settled


def lists_where(lists: TileLists, tiles: torch.Tensor) -> TileLists:
    """The lists of the tiles `[tiles]` that are not 0; the others' are empty."""
    if tiles.all():
        return lists
    lengths = lists.starts.diff()
    entries = torch.repeat_interleave(tiles, lengths.long()).nonzero()[:, 0]
    starts = torch.zeros_like(lists.starts)
    starts[1:] = (lengths * tiles).cumsum(0)
    slot_of = lists.slot_of[entries] if len(lists.slot_of) else lists.slot_of  # empty where no gradient is wanted
    return TileLists(starts, lists.ids[entries], slot_of, lists.first_slot)


def add_window(whole: torch.Tensor, w: Window, planes: torch.Tensor) -> None:
    """Add a window's planes to the image's `[G, C, H, W]`."""
    inside = whole[..., w.top * TILE : (w.top + w.tiles_y) * TILE, w.left * TILE : (w.left + w.tiles_x) * TILE]
    inside += planes[..., : inside.shape[-2], : inside.shape[-1]]


def draw_rays(
    settings: Settings, w: Window, lists: TileLists, scene: Projected, planes: torch.Tensor, picks: torch.Tensor, elsewhere: torch.Tensor
) -> None:
    """Fill the window's planes and picks, but of tiles that are drawn elsewhere."""
    if elsewhere.all():
        return
    bands, longest, working = _working(lists)
    args = [view(lists.starts, int), view(lists.ids, int), *_scene(w, scene, planes), view(elsewhere, int)]
    args += [w, bands, settings.alpha_max, settings.termination, *working, lanes_of(planes), lanes_of(picks)]
    run(composite_rays(settings.wanted, *_way(settings)), bands, args, planes.device)


def draw_rays_backward(
    settings: Settings, part: Part, lists: TileLists, scene: Projected, grads: torch.Tensor, slots: torch.Tensor,
    channel_slots: torch.Tensor, elsewhere: torch.Tensor,
) ->  tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    """Fill the gradient slots; return those of the canonical frames `[I, FRAME]`, and the rays' gradient `[G, C, rows, pitch]`."""
    assert scene.frames is not None and scene.rays is not None
    ray = settings.model.response == "ray"
    frame_slots = slots.new_zeros(len(slots) if ray else 0, FRAME)
    g_rays = torch.zeros(*scene.rays.shape[:2], *part.planes.shape[1:], dtype=torch.float64)
    bands, longest, working = _working(lists)
    args = [view(lists.starts, int), view(lists.ids, int), view(lists.slot_of, int), *_scene(part.window, scene, part.planes)]
    args += [view(elsewhere, int), part.window, bands, settings.alpha_max, settings.termination, *working]
    sums = torch.empty(bands, longest, SUMS, dtype=torch.float64)
    args += [lanes_of(part.planes), lanes_of(grads), view(sums, wp.float64), view(slots, float), view(channel_slots, float)]
    args += [view(frame_slots, float)]
    run(composite_rays_gradient(settings.wanted, *_way(settings)), bands, [*args, lanes_of(g_rays)], slots.device)
    return frame_slots, g_rays


def _way(settings: Settings) -> tuple[bool, bool, bool, int]:
    return settings.model.response == "ray", settings.eyes, settings.config.order == "pixel", settings.squarings


def _scene(w: Window, scene: Projected, planes: torch.Tensor) -> list:
    assert scene.frames is not None and scene.rays is not None
    features = scene.records.new_empty(1, 1) if scene.features is None else scene.features
    rays = torch.zeros(*scene.rays.shape[:2], *planes.shape[1:], dtype=torch.float64)
    rays[:, 2] = 1  # beyond the image's edge
    inside = scene.rays[..., w.top * TILE : (w.top + w.tiles_y) * TILE, w.left * TILE : (w.left + w.tiles_x) * TILE]
    rays[..., : inside.shape[-2], : inside.shape[-1]] = inside
    splats = [view(scene.records, lanes), view(scene.slopes, wp.vec2), view(scene.frames, wp.float64), view(features, float)]
    return [*splats, scene.channels, lanes_of(rays)]


@kept_beside
def _extent(rays: torch.Tensor, tile: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Middle and half of the extent, `[G, C, tiles_y, tiles_x]` each, of the rays of every tile of the image."""
    with torch.no_grad():
        high, low = (sign * torch.nn.functional.max_pool2d(sign * rays, tile, ceil_mode=True) for sign in (1, -1))
        return 0.5 * (high + low), 0.5 * (high - low)


def _working(lists: TileLists) -> tuple:
    """How many bands, the longest tile list, and what the kernels are told: a power of two no less, and working memory as long."""
    longest = max(1, int(lists.starts.diff().max()))
    bands = max(1, min(BANDS, MOST_HELD // longest))
    column = view(torch.arange(TILE, dtype=torch.float32)[None], lanes)
    held = torch.empty(bands, LISTS, longest, TILE, dtype=torch.float32)
    keys, reach = torch.empty(bands * longest, TILE, dtype=torch.float64), torch.empty(bands, 3, longest, dtype=torch.int32)
    memory = [view(held, lanes), view(held, float), view(keys, lanes64), view(keys.view(-1), wp.float64), view(reach, int)]
    return bands, longest, [1 << (longest - 1).bit_length(), column, *memory]
