"""From projected records to planes of the picture, and back to gradient slots: window by window, on the CPU's lanes or CUDA's blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import warp as wp

from render.block_compositing import draw_blocks, draw_blocks_backward
from render.chunks import Sums, add_to, room_in, window, windows
from render.kernels.composite import BATCH, HELD, composite
from render.kernels.composite_backward import SUMS, composite_gradient
from render.kernels.types import GRADIENTS, TILE, Window, lanes
from render.launch import BANDS, run, view
from render.order import TileLists, tile_lists
from render.projected import Part, Projected
from render.ray_compositing import add_window, draw_rays, draw_rays_backward, lanes_of, lists_where, settled_tiles
from render.settings import Settings


@dataclass(frozen=True)
class Picture:
    """Planes `[4.., h, w]` and picks `[0 or 2, h, w]` (`kernels.types.Wanted`), and what backward needs of each part."""

    planes: torch.Tensor
    picks: torch.Tensor
    parts: list[Part]


@dataclass(frozen=True)
class Slots:
    """Gradients of the records: those of record j are values[starts[j] : starts[j] + counts[j]], to be summed; the others are summed:
    channels `[N, C]`, frames `[N, FRAME]`, rays `[G, C, H, W]`."""

    counts: torch.Tensor
    starts: torch.Tensor
    values: torch.Tensor
    channels: torch.Tensor | None
    frames: torch.Tensor | None
    rays: torch.Tensor | None


def by_blocks(device: torch.device) -> bool:
    """Whether blocks of threads composite there, or lanes."""
    return device.type == "cuda"


def draw(settings: Settings, scene: Projected) -> Picture:
    """The picture, or the crop of it that is wanted."""
    x, y, width, height = settings.part
    whole = window(settings.tile_left, settings.tile_top, settings.tiles_x, settings.tiles_y)
    parts: list[Part] = []
    total = None if settings.room else int(scene.counts.sum(dtype=torch.int64))
    most = settings.config.most_entries
    divided = [whole] if total is None or total <= most else windows(scene.records, scene.counts, whole, most)
    planes = picks = scene.records
    for w in divided:
        lists, counts = _lists(settings, scene, w, len(divided) == 1, total)
        drawn, picked, ends = _composite(settings, w, lists, scene)
        if len(divided) == 1:
            planes, picks = drawn, picked
            parts.append(Part(w, lists, counts, ends, drawn))
        else:
            if not parts:
                planes, picks = (p.new_empty(len(p), whole.tiles_y * TILE, whole.tiles_x * TILE) for p in (drawn, picked))
            for all_of_it, part in ((planes, drawn), (picks, picked)):
                _inside(all_of_it, w, whole).copy_(part[..., : w.tiles_x * TILE])
            parts.append(Part(w, None, None, ends, drawn))
    dx, dy = x - whole.left * TILE, y - whole.top * TILE
    planes, picks = (p[..., dy : dy + height, dx : dx + width] for p in (planes, picks))
    if settings.mask is not None:  # as if nothing stood where it is False
        here = settings.mask[settings.of_image]
        planes = torch.cat([planes[:1].where(here, 1), planes[1:].where(here, 0)])
        picks = picks.where(here, 0)
    return Picture(planes, picks, parts)


def draw_backward(settings: Settings, scene: Projected, parts: list[Part], gradients: Sequence[torch.Tensor | None]) -> Slots:
    """gradients: dL/d planes in the planes' order `[.., h, w]`; None for those that are not wanted."""
    device = scene.records.device
    sums = Sums(scene.counts) if len(parts) > 1 else None
    g_features = None if scene.features is None else torch.zeros_like(scene.features)
    by_frames = scene.frames is not None and settings.model.response == "ray"  # an order has no gradient
    g_frames = torch.zeros_like(scene.frames, dtype=torch.float32) if by_frames else None  # type: ignore[arg-type]
    g_rays = None if scene.rays is None else torch.zeros_like(scene.rays)
    wanted = [g if g.ndim == 3 else g[None] for g in gradients if g is not None]
    if settings.mask is not None:
        wanted = [g.where(settings.mask[settings.of_image], 0) for g in wanted]
    for part in parts:
        lists, counts = part.lists, part.counts
        if lists is None or counts is None:
            lists, counts = _lists(settings, scene, part.window, False)
        slots = torch.empty(lists.ids.shape[0], GRADIENTS, dtype=torch.float32, device=device)
        channel_slots = torch.empty(lists.ids.shape[0], scene.channels, dtype=torch.float32, device=device)
        grads = _of_part(settings, part, wanted)
        frame_slots = None
        if by_blocks(device):
            frame_slots = draw_blocks_backward(settings, part, lists, scene, grads, slots, channel_slots, g_rays)
        elif g_rays is not None:
            settled, *ends = part.ends
            plain, crossing = lists_where(lists, settled), lists_where(lists, 1 - settled)
            _composite_backward(settings, replace(part, ends=tuple(ends)), plain, scene, grads, slots, channel_slots)
            frame_slots, of_window = draw_rays_backward(settings, part, crossing, scene, grads, slots, channel_slots, settled)
            add_window(g_rays, part.window, of_window)
        else:
            _composite_backward(settings, part, lists, scene, grads, slots, channel_slots)
        if g_frames is not None and frame_slots is not None and len(frame_slots):
            add_to(g_frames, counts, lists, frame_slots)
        if g_features is not None:
            add_to(g_features, counts, lists, channel_slots)
        if sums is None:
            return Slots(counts, lists.first_slot, slots, g_features, g_frames, g_rays)
        sums.add(counts, lists, slots)
    assert sums is not None
    return Slots(sums.counts, sums.starts, sums.slots, g_features, g_frames, g_rays)


def _lists(settings: Settings, scene: Projected, w: Window, alone: bool, total: int | None = None) -> tuple[TileLists, torch.Tensor]:
    """The window's tile lists and each record's count in them. alone: the window is all that is drawn, so the counts may be used up, whose
    sum is total, where it is known."""
    counts = scene.counts if alone else room_in(scene.records, scene.counts, w)
    drawn = settings.drawn_tiles(counts.device)
    told = (w, drawn, settings.gradients, counts.device.type == "cpu" and settings.room is None, settings.room)
    return tile_lists(scene.records, scene.reach, scene.order, counts, *told, total if alone else None), counts


def _planes(w: Window, count: int, device) -> torch.Tensor:
    """Row-major planes `[count, rows, pitch * 16]` of a window, not initialised: the kernels write every pixel of every tile.

    A stored row has an odd number of tiles, so that the 16 rows of a tile do not fall into one cache set on wide images.
    """
    return torch.empty(count, w.tiles_y * TILE, (w.tiles_x | 1) * TILE, dtype=torch.float32, device=device)


def _inside(planes: torch.Tensor, w: Window, whole: Window) -> torch.Tensor:
    """The window's pixels of planes of a whole."""
    top, left = (w.top - whole.top) * TILE, (w.left - whole.left) * TILE
    return planes[..., top : top + w.tiles_y * TILE, left : left + w.tiles_x * TILE]


def _of_part(settings: Settings, part: Part, gradients: Sequence[torch.Tensor]) -> torch.Tensor:
    """The window's planes of dL/d plane, with T dL/dT for the first; 0 beyond the image."""
    w = part.window
    # of the window in the picture; negative where it begins before it
    left, top = w.left * TILE - settings.part[0], w.top * TILE - settings.part[1]
    columns, rows = slice(max(left, 0), left + w.tiles_x * TILE), slice(max(top, 0), top + w.tiles_y * TILE)
    planes = _planes(w, sum(len(g) for g in gradients), part.planes.device).zero_()
    first = 0
    for g in gradients:
        inside = g[:, rows, columns]
        down, right = max(-top, 0), max(-left, 0)
        planes[first : first + len(g), down : down + inside.shape[1], right : right + inside.shape[2]] = inside
        first += len(g)
    planes[0].mul_(part.planes[0])
    return planes


def _splats(scene: Projected) -> list:
    return [view(scene.records, lanes), view(scene.slopes, wp.vec2)]


def _features(scene: Projected) -> list:
    features = scene.records.new_empty(1, 1) if scene.features is None else scene.features
    return [view(features, float), scene.channels]


def _composite(settings: Settings, w: Window, lists: TileLists, scene: Projected):
    """Planes, picks, and where compositing ended: one past the last entry of each row, and where in the tile's list each pixel went
    dark (CPU); as of `draw_blocks` (CUDA)."""
    device = scene.records.device
    planes = _planes(w, settings.wanted.first_channel + scene.channels, device)
    picks = _planes(w, 2 if settings.wanted.picks else 0, device)
    if by_blocks(device):
        return planes, picks, draw_blocks(settings, w, lists, scene, planes, picks)
    if settings.by_rays:
        settled = settled_tiles(settings, w, lists, scene)
        ends = _by_tile(settings, w, lists_where(lists, settled), scene, planes, picks)
        draw_rays(settings, w, lists_where(lists, 1 - settled), scene, planes, picks, settled)
        return planes, picks, (settled, *ends)
    return planes, picks, _by_tile(settings, w, lists, scene, planes, picks)


def _by_tile(settings: Settings, w: Window, lists: TileLists, scene: Projected, planes, picks) -> tuple[torch.Tensor, ...]:
    """Fill planes and picks in the tiles' order; returns where compositing ended."""
    device = scene.records.device
    lists_of = [view(lists.starts, int), view(lists.ids, int)]
    limits = [settings.alpha_max, settings.termination]
    ends = planes.shape[1:] if settings.gradients else (0, 0)
    last, dark_at = torch.empty(ends[0], ends[1] // TILE, dtype=torch.int32), torch.empty(ends, dtype=torch.float32)
    args = [*lists_of, *_splats(scene), *_features(scene), w, BANDS, *limits, *_working(scene.channels), *_batches()]
    out = [lanes_of(planes), lanes_of(picks), view(last, int), lanes_of(dark_at)]
    run(composite(settings.wanted, settings.squarings, settings.gradients), BANDS, [*args, *out], device)
    return last, dark_at


def _composite_backward(settings: Settings, part: Part, lists: TileLists, scene: Projected, grads, slots, channel_slots) -> None:
    """Fill the gradient slots of the window's entries; grads are planes as of `_of_part`."""
    w = part.window
    lists_of = [view(lists.starts, int), view(lists.ids, int), view(lists.slot_of, int)]
    args = [*lists_of, *_splats(scene), *_features(scene), w, BANDS, settings.alpha_max, *_working(scene.channels)]
    terms = torch.empty(BANDS * int(3 * BATCH + SUMS), TILE, dtype=torch.float32)
    args += [
        view(terms, lanes),
        view(terms.view(-1), float),
        view(terms.view(-1, 4), wp.vec4),
        view(torch.empty(BANDS * int(BATCH), dtype=torch.int32), int),
    ]
    sums = view(torch.zeros(BANDS, max(scene.channels, 1), TILE, dtype=torch.float32), lanes)
    ends = [view(part.ends[0], int), lanes_of(part.ends[1])]
    out = [view(slots, float), view(channel_slots, float)]
    kernel = composite_gradient(settings.wanted, settings.squarings)
    run(kernel, BANDS, [*args, lanes_of(part.planes), lanes_of(grads), *ends, *out, sums], grads.device)


def _working(channels: int) -> list:
    """0 to 15 and their powers of two, and working rows of the tile at hand for each band; 17 where 16 are used, so that those of its
    fields do not fall on one another in the store buffer, which tells addresses apart by their last 12 bits."""
    ramp = torch.arange(TILE, dtype=torch.float32)
    return [
        view(torch.stack([ramp, ramp.exp2()]), lanes),
        view(torch.empty(BANDS, int(HELD) + channels, TILE + 1, TILE, dtype=torch.float32), lanes),
    ]


def _batches() -> list:
    """Where forward keeps the entries of the batch at hand for each band."""
    entries = BANDS * int(BATCH)
    terms = torch.empty(2 * entries, TILE, dtype=torch.float32)
    corners = torch.empty(entries, 3, dtype=torch.float32)
    return [
        view(torch.empty(entries, TILE, dtype=torch.float32), lanes),
        view(corners, wp.vec3),
        view(terms, lanes),
        view(terms.view(-1), float),
    ]
