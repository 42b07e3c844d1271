"""How far a rendered picture is from the recorded one: L1 and structural dissimilarity, with a hand-written gradient.

The reported metric is render/compare.py's; this is its differentiable twin, arranged for speed: channels last, a separable
window, and only the terms of the gradient that are not the recorded picture's.
"""

from __future__ import annotations

from functools import lru_cache

import torch
import torch.nn.functional as F
import warp as wp

from recon.kernels.similarity import similar_kernel
from render.launch import run, stage, view

WINDOW, HALF = 11, 5
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2

STEP = 3
"""Similarity is taken at every so many rows and columns: its window is wide enough to weigh every pixel within 3 % of the mean, at a third
of the cost. A part of the picture costs less, but splats outside it hear of similarity in one picture of many."""

Lattice = tuple[int, int, int]
"""Where a window is taken: at every so many rows and columns, from which row, and from which column on."""

EVERYWHERE: Lattice = (1, 0, 0)


def _blur(maps: torch.Tensor, lattice: Lattice) -> torch.Tensor:
    """Gaussian window over `[H, W, C]` at a lattice's points `[h, w, C]`, zero beyond the edge."""
    if maps.device.type == "cuda":
        return _blur_by_matrices(maps, lattice)
    step, top, left = lattice
    count = maps.shape[-1]
    across, down = _kernels(count, maps.dtype)
    # channels last with one group a channel takes oneDNN's direct path, 30x faster than planes; the batch axis has to lead
    # before the permutation, or its stride is not the one that oneDNN asks for
    planes = F.conv2d(maps[None].permute(0, 3, 1, 2), down, stride=(step, 1), padding=(HALF - top, 0), groups=count)
    return F.conv2d(planes, across, stride=(1, step), padding=(0, HALF - left), groups=count).permute(0, 2, 3, 1)[0]


def _blur_back(maps: torch.Tensor, lattice: Lattice, height: int, width: int) -> torch.Tensor:
    """The adjoint of `_blur`: what a lattice's points `[h, w, C]` say of a picture `[height, width, C]`."""
    if maps.device.type == "cuda":
        return _blur_back_by_matrices(maps, lattice, height, width)
    step, top, left = lattice
    rows, columns, count = maps.shape
    across, down = _kernels(count, maps.dtype)
    lower, right = (n - (step * (k - 1) + WINDOW - 2 * (HALF - p)) for n, k, p in ((height, rows, top), (width, columns, left)))
    planes = F.conv_transpose2d(
        maps[None].permute(0, 3, 1, 2), across, stride=(1, step), padding=(0, HALF - left), output_padding=(0, right), groups=count
    )
    planes = F.conv_transpose2d(planes, down, stride=(step, 1), padding=(HALF - top, 0), output_padding=(lower, 0), groups=count)
    return planes.permute(0, 2, 3, 1)[0]


def _blur_by_matrices(maps: torch.Tensor, lattice: Lattice) -> torch.Tensor:
    """`_blur` for a GPU, which is slow at many channels of a filter each, and fast at matrices that are mostly 0."""
    down, across = _bands(maps, lattice, *maps.shape[:2])
    return (down @ maps.permute(2, 0, 1) @ across.T).permute(1, 2, 0)


def _blur_back_by_matrices(maps: torch.Tensor, lattice: Lattice, height: int, width: int) -> torch.Tensor:
    down, across = _bands(maps, lattice, height, width)
    return (down.T @ maps.permute(2, 0, 1) @ across).permute(1, 2, 0)


def _bands(like: torch.Tensor, lattice: Lattice, height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The window along rows and along columns, a lattice's point a row: `[h, height]` and `[w, width]`."""
    step, top, left = lattice
    down, across = (_band(n, like.dtype, like.device)[first : n - first : step] for n, first in ((height, top), (width, left)))
    return down, across


@lru_cache(maxsize=8)
def _band(size: int, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """The window as a symmetric matrix `[size, size]`; shared, not to be written to."""
    away = torch.arange(size)[:, None] - torch.arange(size) + HALF
    near = (away >= 0) & (away < WINDOW)
    return torch.where(near, _taps(dtype)[away.clamp(0, WINDOW - 1)], 0.0).to(device)


@lru_cache(maxsize=8)
def _kernels(count: int, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """The window across a row and down a column, of `count` channels; shared, not to be written to."""
    across = _taps(dtype).expand(count, 1, 1, WINDOW).contiguous()
    return across, across.transpose(2, 3).contiguous()


def _taps(dtype: torch.dtype) -> torch.Tensor:
    x = torch.arange(WINDOW, dtype=dtype) - HALF
    k = torch.exp(-x * x / (2 * SIGMA * SIGMA))
    return k / k.sum()


def similarity(a: torch.Tensor, b: torch.Tensor, lattice: Lattice = EVERYWHERE) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean structural similarity (Wang et al. 2004) of pictures `[H, W, C]` with peak 1 at a lattice's points, and its gradient in `a`."""
    real = wp.float64 if a.dtype == torch.float64 else wp.float32
    maps = _blur(torch.cat([a, b, a * a, b * b, a * b], -1), lattice)
    (rows, columns), channels = maps.shape[:2], a.shape[-1]
    value, slopes = maps.new_empty(rows, columns, channels), maps.new_empty(rows, columns, 3 * channels)
    with stage(maps.device):
        args = [view(maps, real), C1, C2, view(value, real), view(slopes, real)]
        run(similar_kernel(real), rows * columns, args, maps.device)
    back = _blur_back(slopes, lattice, *a.shape[:2])
    g_mean, g_aa, g_ab = back.split(a.shape[-1], -1)
    return value.mean(), (g_mean + 2 * a * g_aa + b * g_ab) / value.numel()


class PictureLoss(torch.autograd.Function):
    """(1 - d) L1 + d (1 - SSIM) of pictures `[H, W, 3]` (Kerbl et al. 2023, equation 7), differentiable in the first.

    The similarity is taken at a lattice's points: from a random one of `STEP` x `STEP` on, that is a fair sample but at the last two rows
    and columns.
    """

    @staticmethod
    def forward(ctx, rendered, recorded, dissimilarity: float, lattice: Lattice):
        difference = rendered - recorded
        loss = (1 - dissimilarity) * torch.linalg.vector_norm(difference, 1) / difference.numel()
        gradient = difference.sign_().mul_((1 - dissimilarity) / difference.numel())
        if dissimilarity > 0:
            value, slope = similarity(rendered, recorded, lattice)
            gradient.sub_(slope, alpha=dissimilarity)
            loss = loss + dissimilarity * (1 - value)
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    def backward(ctx, grad):
        return ctx.saved_tensors[0] * grad, None, None, None
