"""How far a rendered picture is from the recorded one: L1 and structural dissimilarity, with a hand-written gradient.

The reported metric is render/compare.py's; this is its differentiable twin, arranged for speed: channels last, a separable
window, and only the terms of the gradient that are not the recorded picture's.
"""

from __future__ import annotations

from functools import lru_cache

import torch
import torch.nn.functional as F

WINDOW = 11
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2


def _blur(maps: torch.Tensor) -> torch.Tensor:
    """Gaussian window over `[H, W, C]`, zero beyond the edge; its own adjoint."""
    if maps.device.type == "cuda":
        return _blur_by_matrices(maps)
    count = maps.shape[-1]
    k = _taps(maps.dtype).expand(count, 1, 1, WINDOW).contiguous()
    # channels last with one group a channel takes oneDNN's direct path, 30x faster than planes; the batch axis has to lead
    # before the permutation, or its stride is not the one that oneDNN asks for
    planes = F.conv2d(maps[None].permute(0, 3, 1, 2), k, padding=(0, WINDOW // 2), groups=count)
    return F.conv2d(planes, k.transpose(2, 3).contiguous(), padding=(WINDOW // 2, 0), groups=count).permute(0, 2, 3, 1)[0]


def _blur_by_matrices(maps: torch.Tensor) -> torch.Tensor:
    """The same for a GPU, which is slow at many channels of a filter each, and fast at matrices that are mostly 0."""
    down, across = (_band(n, maps.dtype, maps.device) for n in maps.shape[:2])
    return (down @ maps.permute(2, 0, 1) @ across).permute(1, 2, 0)


@lru_cache(maxsize=8)
def _band(size: int, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """The window as a symmetric matrix `[size, size]`; shared, not to be written to."""
    away = torch.arange(size)[:, None] - torch.arange(size) + WINDOW // 2
    near = (away >= 0) & (away < WINDOW)
    return torch.where(near, _taps(dtype)[away.clamp(0, WINDOW - 1)], 0.0).to(device)


def _taps(dtype: torch.dtype) -> torch.Tensor:
    x = torch.arange(WINDOW, dtype=dtype) - WINDOW // 2
    k = torch.exp(-x * x / (2 * SIGMA * SIGMA))
    return k / k.sum()


def similarity(a: torch.Tensor, b: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean structural similarity (Wang et al. 2004) of pictures `[H, W, C]` with peak 1, and its gradient in `a`."""
    mu_a, mu_b, aa, bb, ab = (m.contiguous() for m in _blur(torch.cat([a, b, a * a, b * b, a * b], -1)).split(a.shape[-1], -1))
    mean_product, mean_squares = mu_a * mu_b, mu_a * mu_a + mu_b * mu_b
    top_mean, top = 2 * mean_product + C1, 2 * (ab - mean_product) + C2
    bottom_mean, bottom = mean_squares + C1, aa + bb - mean_squares + C2
    below = 1 / (bottom_mean * bottom)
    value = top_mean * top * below
    by_aa = -value / bottom
    by_ab = 2 * top_mean * below
    by_mean = 2 * mu_b * (top - top_mean) * below - 2 * mu_a * value * (1 / bottom_mean - 1 / bottom)
    g_mean, g_aa, g_ab = _blur(torch.cat([by_mean, by_aa, by_ab], -1)).split(a.shape[-1], -1)
    return value.mean(), (g_mean + 2 * a * g_aa + b * g_ab) / a.numel()


class PictureLoss(torch.autograd.Function):
    """(1 - d) L1 + d (1 - SSIM) of pictures `[H, W, 3]` (Kerbl et al. 2023, equation 7), differentiable in the first.

    The similarity is taken on the window (top, left, height, width): a random one a step is a fair sample at a fraction of the cost.
    """

    @staticmethod
    def forward(ctx, rendered, recorded, dissimilarity: float, window: tuple[int, int, int, int]):
        difference = rendered - recorded
        loss = (1 - dissimilarity) * torch.linalg.vector_norm(difference, 1) / difference.numel()
        gradient = difference.sign_().mul_((1 - dissimilarity) / difference.numel())
        if dissimilarity > 0:
            top, left, height, width = window
            part = (slice(top, top + height), slice(left, left + width))
            value, slope = similarity(rendered[part].contiguous(), recorded[part].contiguous())
            gradient[part] -= dissimilarity * slope
            loss = loss + dissimilarity * (1 - value)
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    def backward(ctx, grad):
        return ctx.saved_tensors[0] * grad, None, None, None
