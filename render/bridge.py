"""The only torch.autograd.Function: torch tensors in, Warp kernels, torch tensors out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import warp as wp

from render.chunks import Sums, room_in, windows
from render.frame_types import RenderConfig
from render.kernels.composite import composite, composite_gradient
from render.kernels.composite_cuda import composite_blocks, composite_blocks_gradient
from render.kernels.types import GRADIENTS, RECORD, TILE, Window, lanes
from render.launch import BANDS, run, run_blocks, stage, view
from render.order import TileLists, depth_order, tile_lists
from render.projection import projection, uniforms
from scenes.gaussians import SplatModel
from scenes.lenses import Lens, Pinhole

POSE_CHUNK = 64
"""Splats whose pose gradient one CPU thread item sums before it writes."""

FIELDS = 5
"""Tensors of one `Gaussians`."""


@dataclass(frozen=True)
class Settings:
    """What stays the same during one call: image size, model, config, outputs, instance ids, lens type, and what the shutter does."""

    width: int
    height: int
    model: SplatModel
    config: RenderConfig
    depth: bool
    instance: bool
    instances: tuple[int, ...]
    lens: type[Lens] = Pinhole
    shutter: str = "global"
    rolling: bool = False

    @property
    def tiles_x(self) -> int:
        return -(-self.width // TILE)

    @property
    def tiles_y(self) -> int:
        return -(-self.height // TILE)

    @property
    def cutoff(self) -> float:
        return max(self.config.alpha_cutoff, 1e-10)

    @property
    def squarings(self) -> int:
        """How often exp's polynomial is squared, so that its argument stays within 0.75."""
        return max(3, math.ceil(math.log2(-math.log(self.cutoff) / 0.75)))

    @property
    def least_opacity(self) -> float:
        """Splats up to this opacity are not drawn: all below the cutoff, or, where faint ones have cutoffs of their own, far below it."""
        return self.cutoff if self.config.faint <= self.cutoff else self.cutoff / 64

    @property
    def alpha_max(self) -> float:
        return min(self.config.alpha_max, 1 - 1e-6)

    @property
    def termination(self) -> float:
        """Transmittance below which a pixel is done. Not 0: backward divides by what is left, so nothing may underflow."""
        return max(self.config.termination, 1e-10)

    def crop(self, planes: torch.Tensor) -> torch.Tensor:
        return planes[..., : self.height, : self.width]


@dataclass
class Part:
    """A window of the image, as drawn: its lists and their exact counts (None where backward shall make them again, to save memory),
    where compositing ended, and the final transmittance."""

    window: Window
    lists: TileLists | None = None
    counts: torch.Tensor | None = None
    ends: tuple[torch.Tensor, ...] = ()
    final_t: torch.Tensor | None = None


def _planes(window: Window, count: int, device) -> torch.Tensor:
    """Row-major planes `[count, rows, pitch * 16]` of a window, not initialised: the kernels write every pixel of every tile.

    A stored row has an odd number of tiles, so that the 16 rows of a tile do not fall into one cache set on wide images.
    """
    return torch.empty(count, window.tiles_y * TILE, (window.tiles_x | 1) * TILE, device=device)


def _inside(planes: torch.Tensor, window: Window) -> torch.Tensor:
    """The window's pixels of planes of the whole image."""
    top, left = window.top * TILE, window.left * TILE
    return planes[..., top : top + window.tiles_y * TILE, left : left + window.tiles_x * TILE]


def _arrays(fields) -> list:
    means, quats, log_scales, logits, sh = fields
    return [view(means, wp.vec3), view(quats, wp.vec4), view(log_scales, wp.vec3), view(logits, float), view(sh, wp.vec3)]


class Rasterize(torch.autograd.Function):
    """The kernels behind `rasterize`, which calls this inside a `stage`.

    (settings, poses [P, C, 4, 4] f64 as `projection.poses`, lens parameters f64, 5 fields of P instances) -> rgb [3, H, W], alpha,
    sum of w z, sum of w, instance.

    The weights are summed beside z, since 1 - T has lost its digits where alpha is small and depth divides by it.
    """

    @staticmethod
    def forward(ctx, settings: Settings, poses, lens, *fields):
        ways = projection(settings.lens, settings.rolling)
        groups = [tuple(f.contiguous() for f in fields[i : i + FIELDS]) for i in range(0, len(fields), FIELDS)]
        draws = [(p, copy) for p in range(len(groups)) for copy in range(ways.copies)]
        groups = [groups[p] for p, _ in draws]
        sizes = [g[0].shape[0] for g in groups]
        bases = [sum(sizes[:i]) for i in range(len(sizes))]
        device = fields[0].device
        n = sum(sizes)
        records = torch.empty(n, RECORD, device=device)
        keys, counts = (torch.empty(n, dtype=torch.int32, device=device) for _ in range(2))
        told = []
        still, lens_now = poses.detach().cpu(), settings.lens(*lens.tolist())
        for (p, copy), group, base in zip(draws, groups, bases, strict=True):
            told.append([*uniforms(settings, lens_now, still[p], settings.instances[p], group[4].shape[1], copy), base])
            args = [*_arrays(group), *told[-1], view(records, float), view(keys, int), view(counts, int)]
            run(ways.forward, len(group[0]), args, device)
        order = depth_order(keys)
        parts = [Part(w) for w in windows(records, counts, settings.tiles_x, settings.tiles_y, settings.config.most_entries)]
        planes = records
        for part in parts:
            room = counts if len(parts) == 1 else room_in(records, counts, part.window)
            lists = tile_lists(records, order, room, part.window, counting=device.type == "cpu")
            drawn, part.ends = _composite(settings, part.window, lists, records)
            part.final_t = drawn[0]
            if len(parts) == 1:
                planes, part.lists, part.counts = drawn, lists, room
            else:
                if part is parts[0]:
                    planes = drawn.new_empty(len(drawn), settings.tiles_y * TILE, settings.tiles_x * TILE)
                _inside(planes, part.window).copy_(drawn[..., : part.window.tiles_x * TILE])
        ctx.settings, ctx.groups, ctx.told, ctx.draws, ctx.parts = settings, groups, told, draws, parts
        ctx.records, ctx.counts, ctx.order = records, counts, order
        ctx.like_pose, ctx.like_lens = poses.new_empty(0), lens.new_empty(lens.shape)
        rgb = settings.crop(planes[1:4])
        alpha = 1 - settings.crop(planes[0])
        z, weights = settings.crop(planes[4:6]) if settings.depth else (None, None)
        instance = None
        if settings.instance:
            instance = torch.where(alpha < 0.5, -1, settings.crop(planes[6])).to(torch.int32)
            ctx.mark_non_differentiable(instance)
        return rgb, alpha, z, weights, instance

    @staticmethod
    def backward(ctx, g_rgb, g_alpha, g_z, g_weights, _g_instance):
        settings, device = ctx.settings, ctx.records.device
        outputs: list = []
        g_uniform = []
        with stage(device):
            sums = Sums(ctx.counts) if len(ctx.parts) > 1 else None
            for part in ctx.parts:
                counts, lists = part.counts, part.lists
                if lists is None:
                    counts = room_in(ctx.records, ctx.counts, part.window)
                    lists = tile_lists(ctx.records, ctx.order, counts, part.window, counting=device.type == "cpu")
                grads = _part_gradients(settings, part, g_rgb, g_alpha, g_z, g_weights)
                slots = _composite_backward(settings, part, lists, ctx.records, grads)
                starts = lists.first_slot
                if sums is not None:
                    sums.add(counts, lists, slots)
                    counts, starts, slots = sums.counts, sums.starts, sums.slots
            ways = projection(settings.lens, settings.rolling)
            for (_, copy), group, told in zip(ctx.draws, ctx.groups, ctx.told, strict=True):
                size = len(group[0])
                out = [torch.empty_like(f) for f in group]
                chunk = POSE_CHUNK if device.type == "cpu" else 1
                items = -(-size // chunk)
                shared = torch.empty(items, ways.uniforms, device=device)
                args = [*_arrays(group), *told, size, chunk, view(counts, int), view(starts, int), view(slots, float)]
                run(ways.backward, items, [*args, *_arrays(out), view(shared, float)], device)
                if copy:  # the other side of a seam: the same splats and the same pose once more
                    for first, second in zip(outputs[-FIELDS:], out, strict=True):
                        first += second
                    g_uniform[-1] = torch.cat([g_uniform[-1], shared])
                else:
                    outputs += out
                    g_uniform.append(shared)
        if not any(ctx.needs_input_grad[1:3]):
            return None, None, None, *outputs
        shared = torch.stack([g.sum(0, dtype=torch.float64).cpu() for g in g_uniform])
        g_lens = ways.lens_gradient(shared, len(ctx.like_lens))
        return None, ways.pose_gradient(shared).to(ctx.like_pose), g_lens.to(ctx.like_lens), *outputs


def _part_gradients(settings: Settings, part: Part, g_rgb, g_alpha, g_z, g_weights) -> torch.Tensor:
    """The window's planes of dL/d (r, g, b), T * dL/dT, and, with depth, dL/d (w z, w); 0 beyond the image."""
    assert part.final_t is not None
    grads = _planes(part.window, 6 if settings.depth else 4, part.final_t.device).zero_()
    image = [g_rgb, g_alpha[None], *((g_z[None], g_weights[None]) if settings.depth else ())]
    first = 0
    for g in image:
        inside = _inside(g, part.window)
        grads[first : first + len(g), : inside.shape[1], : inside.shape[2]] = inside
        first += len(g)
    grads[3].neg_().mul_(part.final_t)  # alpha = 1 - T
    return grads


def _lane_planes(planes: torch.Tensor) -> list:
    return [view(p.view(p.shape[0], -1, TILE), lanes) for p in planes]


def _composite(settings: Settings, window: Window, lists: TileLists, records: torch.Tensor):
    """Planes (T, r, g, b[, w z, w][, instance]) and where compositing ended: one past the last entry of each row, and where in the
    tile's list each pixel went dark (CPU); one past the last entry of each pixel (CUDA)."""
    device, tiles = records.device, window.tiles_x * window.tiles_y
    planes = _planes(window, 7 if settings.instance else 6 if settings.depth else 4, device)
    lists_of = [view(lists.starts, int), view(lists.ids, int), view(records, float if device.type == "cuda" else lanes)]
    limits = [settings.alpha_max, settings.termination]
    if device.type == "cuda":
        last = torch.empty(planes.shape[1:], dtype=torch.int32, device=device)
        out = [view(planes[min(i, len(planes) - 1)], float) for i in range(7)]
        kernel = composite_blocks(settings.depth, settings.instance, TILE)
        run_blocks(kernel, tiles, TILE * TILE, [*lists_of, window, *limits, *out, view(last, int)], device)
        return planes, (last,)
    last = torch.empty(planes.shape[1], planes.shape[2] // TILE, dtype=torch.int32)
    dark_at = _planes(window, 1, device)
    rows = _lane_planes(planes)
    out = [rows[min(i, len(rows) - 1)] for i in range(7)]
    kernel = composite(settings.depth, settings.instance, settings.squarings)
    run(kernel, BANDS, [*lists_of, window, BANDS, *limits, *_working(), *out, view(last, int), *_lane_planes(dark_at)], device)
    return planes, (last, dark_at)


def _composite_backward(settings: Settings, part: Part, lists: TileLists, records: torch.Tensor, grads: torch.Tensor) -> torch.Tensor:
    """The gradient slots `[I, GRADIENTS]` of the window's entries; grads are planes as of `_part_gradients`."""
    assert part.final_t is not None
    device, tiles = records.device, part.window.tiles_x * part.window.tiles_y
    on_cuda = device.type == "cuda"
    slots = torch.empty(lists.ids.shape[0], GRADIENTS, device=device)
    lists_of = [view(lists.starts, int), view(lists.ids, int), view(lists.slot_of, int), view(records, float if on_cuda else lanes)]
    r, g, b, t_gradient, *extra = [view(p, float) for p in grads] if on_cuda else _lane_planes(grads)
    z, w = extra or (r, r)
    if on_cuda:
        kernel = composite_blocks_gradient(settings.depth, TILE)
        ends = [view(part.ends[0], int), view(part.final_t, float)]
        args = [*lists_of, part.window, settings.alpha_max, r, g, b, z, w, *ends, t_gradient]
        run_blocks(kernel, tiles, TILE * TILE, [*args, view(slots, float)], device)
        return slots
    args = [*lists_of, part.window, BANDS, settings.alpha_max, *_working(), r, g, b, z, w, view(part.ends[0], int)]
    kernel = composite_gradient(settings.depth, settings.squarings)
    lanes_of_pixels = [*_lane_planes(part.ends[1]), *_lane_planes(part.final_t[None])]
    run(kernel, BANDS, [*args, *lanes_of_pixels, t_gradient, view(slots, float)], device)
    return slots


def _working() -> list:
    """The column ramp, and working rows of the tile at hand for each band."""
    return [view(torch.arange(TILE, dtype=torch.float32)[None], lanes), view(torch.empty(BANDS, 10, TILE, TILE), lanes)]
