"""A rendered picture with the sky behind it, exposed as its camera exposes: one pass over the pixels, and one back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import torch
import warp as wp

from recon.kernels.develop import SKY_STEP, develop, develop_backward
from render.launch import run, stage, upload, view
from render.rays import on_device
from scenes.camera import Camera


def developed(
    rgb: torch.Tensor,
    alpha: torch.Tensor,
    sky: Callable[[torch.Tensor], torch.Tensor],
    exposure: torch.Tensor,
    camera: Camera,
    shift: Sequence[int],
) -> torch.Tensor:
    """`[H, W, 3]`: E[:, :3] (rgb + (1 - alpha) sky) + E[:, 3]; differentiable in premultiplied rgb `[H, W, 3]`, alpha `[H, W]`, what the
    sky's colours `[h, w, 3]` by directions `[h, w, 3]` in the world are made of, and the exposure `[3, 4]`.

    The sky is smooth, and a lookup a pixel would cost as much as the splats: it is sampled every `SKY_STEP` pixels, at others with every
    `shift` (rows and columns, below `SKY_STEP`), or those between would never learn.
    """
    rays = on_device(_sample_rays(camera.lens.key(), camera.width, camera.height, tuple(shift)), rgb.device)
    samples = sky(rays @ upload(camera.world_from_cam[:3, :3].detach().float(), rgb.device).T)
    if rgb.device.type == "cuda":
        return developed_by_matrices(rgb, alpha, samples, exposure, shift)
    return Develop.apply(rgb, alpha, samples, exposure, shift)


@lru_cache(maxsize=512)
def _sample_rays(key: tuple, width: int, height: int, shift: tuple[int, int]) -> torch.Tensor:
    """float32 `[h, w, 3]` directions in the camera of the sky's samples; shared, not to be written to."""
    lens_type, *numbers = key
    y, x = (SKY_STEP * (torch.arange(n // SKY_STEP + 2) + 0.5) - s for n, s in zip((height, width), shift, strict=True))
    return lens_type(*numbers).unproject(torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).double()).float()


def developed_by_matrices(rgb: torch.Tensor, alpha: torch.Tensor, samples: torch.Tensor, exposure: torch.Tensor, shift: Sequence[int]):
    """As `Develop`, for a GPU, which would stand idle with a thread for each row of samples."""
    down, across = (_between(n, s, rgb.device) for n, s in zip(alpha.shape, shift, strict=True))
    behind = (down @ samples.permute(2, 0, 1) @ across.T).permute(1, 2, 0)
    # row by row, or the exposure's gradient would be one sum over all pixels
    return (rgb + (1 - alpha)[..., None] * behind) @ exposure[:, :3].T.expand(len(rgb), 3, 3) + exposure[:, 3]


@lru_cache(maxsize=64)
def _between(pixels: int, shift: int, device: torch.device) -> torch.Tensor:
    """`[pixels, samples]`: what each sample along a side adds to each pixel; shared, not to be written to."""
    samples = pixels // SKY_STEP + 2
    place = ((torch.arange(pixels) + shift + 0.5) / SKY_STEP - 0.5).clamp(0, samples - 1)
    return (1 - (place[:, None] - torch.arange(samples)).abs()).clamp_min(0).to(device)


class Develop(torch.autograd.Function):
    """(rgb [H, W, 3], alpha [H, W], samples of the sky [h, w, 3], exposure [3, 4], shift) -> [H, W, 3]."""

    @staticmethod
    def forward(ctx, rgb, alpha, samples, exposure, shift: Sequence[int]):
        kept = (rgb, alpha, samples.contiguous(), exposure.contiguous())
        ctx.save_for_backward(*kept)
        ctx.shift = shift
        out = torch.empty(rgb.shape, device=rgb.device)
        with stage(rgb.device):
            run(develop, len(samples) + 1, [*_told(kept, shift), view(out, wp.vec3)], rgb.device)
        return out

    @staticmethod
    def backward(ctx, g_out):
        kept = ctx.saved_tensors
        rgb, alpha, samples, exposure = kept
        rows, device = len(samples) + 1, rgb.device
        g_rgb, g_alpha = torch.empty(3, *alpha.shape, device=device), torch.empty(alpha.shape, device=device)
        g_sky, g_exposure = torch.zeros(rows, 2, *samples.shape[1:], device=device), torch.zeros(rows, 12, device=device)
        with stage(device):
            outs = [view(g_rgb, float), view(g_alpha, float), view(g_sky, wp.vec3), view(g_exposure, float)]
            run(develop_backward, rows, [*_told(kept, ctx.shift), view(g_out.contiguous(), wp.vec3), *outs], device)
        upper = (torch.arange(rows, device=device) - 1).clamp_min(0)
        g_samples = torch.zeros_like(samples).index_add_(0, upper, g_sky[:, 0])
        g_samples.index_add_(0, (upper + 1).clamp_max(rows - 2), g_sky[:, 1])
        return g_rgb.permute(1, 2, 0), g_alpha, g_samples, g_exposure.sum(0).view(3, 4), None


def _told(kept: tuple[torch.Tensor, ...], shift: Sequence[int]) -> list:
    rgb, alpha, samples, exposure = kept
    return [view(rgb, float), view(alpha, float), view(samples, wp.vec3), *shift, view(exposure, float)]
