"""How alike two pictures are: the one definition of PSNR and SSIM in this house."""

from __future__ import annotations

import torch

from scenes.checks import check_tensor


def psnr(a: torch.Tensor, b: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Peak signal to noise ratio in dB of images `[H, W, 3]` with peak 1, both clamped to 0..1; inf where equal.

    mask: bool `[H, W]`, the pixels that count; ValueError where it holds none.
    """
    _check(a, b)
    error = (a.clamp(0, 1) - b.clamp(0, 1)).double().square()
    if mask is not None:
        check_tensor("mask", mask, tuple(a.shape[:2]), torch.bool)
        if not mask.any():
            raise ValueError("the mask holds no pixel, so there is nothing to compare")
        error = error[mask]
    mse = float(error.mean())
    return float("inf") if mse == 0 else -10 * float(torch.log10(torch.tensor(mse, dtype=torch.float64)))


def ssim(a: torch.Tensor, b: torch.Tensor) -> float:
    """Structural similarity (Wang et al. 2004; 11x11 Gaussian window) of images `[H, W, 3]` with peak 1, both clamped to 0..1."""
    from kornia.metrics import ssim as ssim_map

    _check(a, b)
    first, second = (image.clamp(0, 1).permute(2, 0, 1)[None] for image in (a, b))
    return float(ssim_map(first, second, window_size=11).mean())


def _check(a: torch.Tensor, b: torch.Tensor) -> None:
    check_tensor("the first image", a, ("H", "W", 3))
    check_tensor("the second image", b, tuple(a.shape))
