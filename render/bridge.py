"""The only torch.autograd.Function: torch tensors in, Warp kernels, torch tensors out."""

from __future__ import annotations

from dataclasses import replace

import torch
import warp as wp

from render.compositing import draw, draw_backward
from render.kernels.bin import REACH_INTS
from render.kernels.types import MEDIAN, RECORD, WHO
from render.launch import run_each, stage, view
from render.order import depth_order
from render.projected import Projected
from render.projection import projection, uniforms
from render.settings import Settings

POSE_CHUNK = 64
"""Splats whose pose gradient one CPU thread item sums before it writes."""

FIELDS = 5
"""Tensors of one `Gaussians`."""


def _arrays(fields) -> list:
    means, quats, log_scales, logits, sh = fields
    return [view(means, wp.vec3), view(quats, wp.vec4), view(log_scales, wp.vec3), view(logits, float), view(sh, wp.vec3)]


class Rasterize(torch.autograd.Function):
    """The kernels behind `rasterize`, which calls this inside a `stage`.

    (settings, poses [P, C, 4, 4] f64 as `projection.poses`, lens parameters f64, features [N, C] of all splats or None, canonical frames
    [N, FRAME] and rays [H, W, 3] or None where pixels do not look along their own rays, 5 fields of P instances) -> rgb [3, H, W], alpha,
    sum of w z, sum of w, sums of w features [C, H, W], median depth (0 where there is none), instance.

    The weights are summed beside z, since 1 - T has lost its digits where alpha is small and depth divides by it.
    """

    @staticmethod
    def forward(ctx, settings: Settings, poses, lens, features, frames, rays, *fields):
        settings = replace(settings, gradients=settings.gradients and any(ctx.needs_input_grad))
        ways = projection(settings.lens, settings.rolling)
        groups = [tuple(f.contiguous() for f in fields[i : i + FIELDS]) for i in range(0, len(fields), FIELDS)]
        draws = [(p, copy) for copy in range(ways.copies) for p in range(len(groups))]
        groups = [groups[p] for p, _ in draws]
        sizes = [g[0].shape[0] for g in groups]
        bases = [sum(sizes[:i]) for i in range(len(sizes))]
        device = fields[0].device
        n = sum(sizes)
        records = torch.empty(n, RECORD, device=device)
        reach = torch.empty(n, REACH_INTS, dtype=torch.int32, device=device)
        keys, counts = (torch.empty(n, dtype=torch.int32, device=device) for _ in range(2))
        told, jobs = [], []
        still, lens_now = poses.detach().cpu(), settings.lens(*lens.tolist())
        for (p, copy), group, base in zip(draws, groups, bases, strict=True):
            told.append([*uniforms(settings, lens_now, still[p], settings.instances[p], group[4].shape[1], copy), base])
            args = [*_arrays(group), *told[-1], view(records, float), view(reach, int), view(keys, int), view(counts, int)]
            jobs.append((len(group[0]), args))
        run_each(ways.forward, jobs, device)
        per_record, frames = (None if t is None else t.contiguous().repeat(ways.copies, 1) for t in (features, frames))
        scene = Projected(records, reach, counts, depth_order(keys), per_record, frames, rays)
        picture = draw(settings, scene)
        ctx.settings, ctx.groups, ctx.told, ctx.scene, ctx.parts = settings, groups, told, scene, picture.parts
        ctx.like_pose, ctx.like_lens = poses.new_empty(0), lens.new_empty(lens.shape)
        alpha = 1 - picture.planes[0]
        z, weights = picture.planes[4:6] if settings.wanted.depth else (None, None)
        channels = picture.planes[settings.wanted.first_channel :] if settings.wanted.channels else None
        median = picture.picks[MEDIAN] if settings.wanted.median else None
        instance = torch.where(alpha < 0.5, -1, picture.picks[WHO]).to(torch.int32) if settings.wanted.instance else None
        ctx.mark_non_differentiable(*(t for t in (median, instance) if t is not None))
        return picture.planes[1:4], alpha, z, weights, channels, median, instance

    @staticmethod
    def backward(ctx, g_rgb, g_alpha, g_z, g_weights, g_channels, _g_median, _g_instance):
        settings, device = ctx.settings, ctx.scene.records.device
        outs: list = []
        g_uniform: list = []
        jobs = []
        with stage(device):
            slots = draw_backward(settings, ctx.scene, ctx.parts, [-g_alpha[None], g_rgb, g_z, g_weights, g_channels])
            ways = projection(settings.lens, settings.rolling)
            for group, told in zip(ctx.groups, ctx.told, strict=True):
                size = len(group[0])
                out = [torch.empty_like(f) for f in group]
                chunk = POSE_CHUNK if device.type == "cpu" else 1
                items = -(-size // chunk)
                shared = torch.empty(items, ways.uniforms, device=device)
                args = [*_arrays(group), *told, size, chunk, view(slots.counts, int), view(slots.starts, int), view(slots.values, float)]
                jobs.append((items, [*args, *_arrays(out), view(shared, float)]))
                outs.append(out)
                g_uniform.append(shared)
            run_each(ways.backward, jobs, device)
            instances = len(outs) // ways.copies
            for i in range(instances, len(outs)):  # the other side of a seam: the same splats and the same poses once more
                for first, second in zip(outs[i - instances], outs[i], strict=True):
                    first += second
                g_uniform[i - instances] = torch.cat([g_uniform[i - instances], g_uniform[i]])
            outputs = [t for out in outs[:instances] for t in out]
            g_uniform = g_uniform[:instances]
            both_sides = [None if g is None else g.view(ways.copies, -1, g.shape[1]).sum(0) for g in (slots.channels, slots.frames)]
            more = (*both_sides, slots.rays)
        if not any(ctx.needs_input_grad[1:3]):
            return None, None, None, *more, *outputs
        shared = torch.stack([g.sum(0, dtype=torch.float64).cpu() for g in g_uniform])
        g_lens = ways.lens_gradient(shared, len(ctx.like_lens))
        return None, ways.pose_gradient(shared).to(ctx.like_pose), g_lens.to(ctx.like_lens), *more, *outputs
