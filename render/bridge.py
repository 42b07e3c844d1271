"""The only torch.autograd.Function: torch tensors in, Warp kernels, torch tensors out."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, reduce
from operator import add

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from render.compositing import Picture, draw, draw_backward
from render.kernels.bin import REACH_INTS
from render.kernels.canonical import FRAME, make_frames
from render.kernels.types import ITEM, MEDIAN, RECORD, WHO
from render.launch import run_each, stage, upload, view
from render.order import depth_order
from render.projected import Projected
from render.projection import projection, uniforms
from render.settings import Settings
from render.work import Work, work
from scenes.lenses import Lens

FIELDS = 5
"""Tensors of one `Gaussians`."""


def _arrays(fields) -> list:
    means, quats, log_scales, logits, sh = fields
    return [view(means, wp.vec3), view(quats, wp.vec4), view(log_scales, wp.vec3), view(logits, float), view(sh, wp.vec3)]


def _told(camera: list, rows: torch.Tensor, items: torch.Tensor) -> list:
    """What projection's kernels are told beside the splats; last, how many threads share an item."""
    return [*camera, view(rows, wp.float64), view(items, int), _threads(items.device)]


def _threads(device: torch.device) -> int:
    return ITEM if device.type == "cuda" else 1


def _copied(per_splat: torch.Tensor, copies: int) -> torch.Tensor:
    """`[N, C]` for records of as many copies."""
    return per_splat.contiguous() if copies == 1 else per_splat.repeat(copies, 1)


def prepare(settings: Settings, seen, poses: torch.Tensor, lens: torch.Tensor, fields) -> tuple[Work, list, torch.Tensor]:
    """What the host finds out before the device begins: arguments as of `Rasterize`; the work, and what its kernels are told: of all poses
    together, and of each as rows, still on the host."""
    instances = [tuple(f.contiguous() for f in fields[i : i + FIELDS]) for i in range(0, len(fields), FIELDS)]
    return work(instances, seen, projection(settings.lens, settings.rolling).copies), *told_of(settings, poses, lens)


def told_of(settings: Settings, poses: torch.Tensor, lens: torch.Tensor) -> tuple[list, torch.Tensor]:
    """What projection's kernels are told of the camera, and as rows of every pose, on the host: all that changes from pose to pose."""
    copies = projection(settings.lens, settings.rolling).copies
    *told, rows = uniforms(settings, _lens((settings.lens, *lens.tolist())), poses.detach().cpu(), copies)
    return told, rows


@lru_cache(maxsize=16)
def _lens(key: tuple) -> Lens:
    return key[0](*key[1:])


def paint(settings: Settings, todo: Work, told: list, rows: torch.Tensor, features, frames, rays) -> tuple[Projected, Picture]:
    """Project and composite. With a room and without gradients nothing in here waits for the device, so a graph can record it."""
    ways, device = projection(settings.lens, settings.rolling), rows.device
    records = torch.empty(todo.records, RECORD, dtype=torch.float32, device=device)
    sloping = settings.wanted.depths and settings.model.response == "conic"
    slopes = torch.empty(todo.records if sloping else 0, 2, dtype=torch.float32, device=device)
    reach = torch.empty(todo.records, REACH_INTS, dtype=torch.int32, device=device)
    keys, counts = (torch.empty(todo.records, dtype=torch.int32, device=device) for _ in range(2))
    out = [view(records, float), view(slopes, wp.vec2), view(reach, int), view(keys, int), view(counts, int)]
    jobs = [(len(g.items) * _threads(device), [*_arrays(g.fields), *_told(told, rows, g.items), *out]) for g in todo.groups]
    run_each(ways.forward, jobs, device)
    per_record, frames = (None if t is None else _copied(t, ways.copies) for t in (features, frames))
    if frames is None and settings.by_rays:
        frames = torch.empty(todo.records, FRAME, dtype=torch.float64, device=device)
        looks = upload(torch.tensor(settings.looks * ways.copies, dtype=torch.int32), device)
        told_of_frames = [view(looks, int), view(counts, int), view(frames, wp.float64)]
        jobs = [
            (n, [*_arrays(g.fields)[:3], *_told([], rows, g.items), *told_of_frames]) for (n, _), g in zip(jobs, todo.groups, strict=True)
        ]
        run_each(make_frames, jobs, device)
    scene = Projected(records, slopes, reach, counts, depth_order(keys), per_record, frames, rays)
    return scene, draw(settings, scene)


def pictures(settings: Settings, picture: Picture) -> tuple[torch.Tensor | None, ...]:
    """What `Rasterize` gives; None for what is not wanted."""
    passing = picture.planes[0]
    z, weights = picture.planes[4:6] if settings.wanted.depth else (None, None)
    channels = picture.planes[settings.wanted.first_channel :] if settings.wanted.channels else None
    median = picture.picks[MEDIAN] if settings.wanted.median else None
    instance = torch.where(passing > 0.5, -1, picture.picks[WHO]).to(torch.int32) if settings.wanted.instance else None
    return picture.planes[1:4], passing, z, weights, channels, median, instance


def drawn_only(settings: Settings, seen, poses, lens, features, frames, rays, *fields) -> tuple[torch.Tensor | None, ...]:
    """What `Rasterize` gives, where nobody will ask for a gradient; of many instances autograd alone takes a third of a GPU's frame."""
    settings = replace(settings, gradients=False)
    with torch.no_grad():
        todo, told, rows = prepare(settings, seen, poses, lens, fields)
        _, picture = paint(settings, todo, told, upload(rows, fields[0].device), features, frames, rays)
        return pictures(settings, picture)


class Rasterize(torch.autograd.Function):
    """The kernels behind `rasterize`, which calls this inside a `stage`.

    (settings, items seen of each instance as `work` takes them, poses [P, C, 4, 4] f64 as `projection.poses`, lens parameters f64,
    features [N, C] of all splats or None, canonical frames [N, FRAME] where these have gradients, rays [G, C, H, W] where pixels look
    along their own, 5 fields of P instances) -> rgb [3, H, W], light that passes, T = 1 - alpha, sum of w z, sum of w, sums of w features
    [C, H, W], median depth (0 where there is none), instance.

    The weights are summed beside z, since 1 - T has lost its digits where alpha is small and depth divides by it; as 1 - alpha has where T
    is small, by which a background is seen.
    """

    @staticmethod
    def forward(ctx, settings: Settings, seen, poses, lens, features, frames, rays, *fields):
        settings = replace(settings, gradients=settings.gradients and any(ctx.needs_input_grad))
        todo, told, rows = prepare(settings, seen, poses, lens, fields)
        rows = upload(rows, fields[0].device)
        scene, picture = paint(settings, todo, told, rows, features, frames, rays)
        ctx.settings, ctx.work, ctx.told, ctx.rows, ctx.scene, ctx.parts = settings, todo, told, rows, scene, picture.parts
        ctx.save_for_backward(*fields)  # only so that backward refuses fields that were written to meanwhile, as torch's own do
        ctx.like_poses, ctx.like_lens = poses.new_empty(poses.shape), lens.new_empty(lens.shape)
        *sums, median, instance = pictures(settings, picture)
        ctx.mark_non_differentiable(*(t for t in (median, instance) if t is not None))
        return *sums, median, instance

    @staticmethod
    @once_differentiable  # kernels leave no trace: a gradient of gradients is refused, not taken as 0
    def backward(ctx, g_rgb, g_passing, g_z, g_weights, g_channels, _g_median, _g_instance):
        _unchanged = ctx.saved_tensors  # raises where a field was written to
        settings, device, groups = ctx.settings, ctx.scene.records.device, ctx.work.groups
        threads, instances = _threads(device), len(ctx.like_poses)
        outs, shared, jobs = [], [], []
        with stage(device):
            slots = draw_backward(settings, ctx.scene, ctx.parts, [g_passing[None], g_rgb, g_z, g_weights, g_channels])
            ways = projection(settings.lens, settings.rolling)
            for g in groups:
                outs.append([torch.empty_like(f) for f in g.fields])
                shared.append(torch.empty(len(g.items) * threads, ways.uniforms, dtype=torch.float32, device=device))
                summed = [view(slots.counts, int), view(slots.starts, int), view(slots.values, float)]
                args = [*_arrays(g.fields), *_told(ctx.told, ctx.rows, g.items), *summed, *_arrays(outs[-1]), view(shared[-1], float)]
                jobs.append((len(shared[-1]), args))
            run_each(ways.backward, jobs, device)
            outputs: list[list[torch.Tensor]] = [[] for _ in range(instances)]
            uniform: list[list[torch.Tensor]] = [[] for _ in range(instances)]
            for g, out, rows in zip(groups, outs, shared, strict=True):
                rows_of = rows.split([n * threads for n in g.per_member])
                for p, own, *gradients in zip(g.members, rows_of, *(f.split(g.sizes) for f in out), strict=True):
                    uniform[p].append(own)
                    # the other side of a seam: the same splats and the same pose once more
                    outputs[p] = [a + b for a, b in zip(outputs[p], gradients, strict=True)] if outputs[p] else gradients
            both_sides = [None if g is None else g.view(ways.copies, -1, g.shape[1]).sum(0) for g in (slots.channels, slots.frames)]
            more = (*both_sides, slots.rays)
        fields = [f for gradients in outputs for f in gradients]
        if not any(ctx.needs_input_grad[2:4]):
            return None, None, None, None, *more, *fields
        of_pose = torch.stack([reduce(add, (rows.sum(0, dtype=torch.float64) for rows in sides)) for sides in uniform]).cpu()
        g_lens = ways.lens_gradient(of_pose, len(ctx.like_lens))
        return None, None, ways.pose_gradient(of_pose).to(ctx.like_poses), g_lens.to(ctx.like_lens), *more, *fields
