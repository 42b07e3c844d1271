"""How alike two pictures are: the one definition of PSNR and SSIM in this house."""

from __future__ import annotations

import math

import torch

from scenes.checks import check_floats, check_tensor


def psnr(a: torch.Tensor, b: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Peak signal to noise ratio in dB of images `[H, W, 3]` with peak 1, both clamped to 0..1; inf where equal.

    mask: bool `[H, W]`, the pixels that count; ValueError where it holds none.
    """
    _check(a, b, mask)
    error = (a.clamp(0, 1) - b.clamp(0, 1)).double().square()
    if mask is not None:
        error = error[mask]
    return decibels(float(error.mean()))


def decibels(mse: float) -> float:
    """The PSNR in dB of a mean squared error at peak 1; inf where it is 0."""
    return math.inf if mse == 0 else -10 * math.log10(mse)


def ssim(a: torch.Tensor, b: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Structural similarity (Wang et al. 2004; 11x11 Gaussian window) of images `[H, W, 3]` with peak 1, both clamped to 0..1.

    mask: bool `[H, W]`, the pixels that count; in the windows around those the others are alike. ValueError where it holds none.
    """
    from kornia.metrics import ssim as ssim_map

    _check(a, b, mask)
    if mask is not None:
        b = torch.where(mask[..., None], b, a)
    first, second = (image.clamp(0, 1).permute(2, 0, 1)[None] for image in (a, b))
    values = ssim_map(first, second, window_size=11)
    return float((values if mask is None else values[..., mask]).mean())


def _check(a: torch.Tensor, b: torch.Tensor, mask: torch.Tensor | None) -> None:
    check_tensor("the first image", a, ("H", "W", 3))
    check_tensor("the second image", b, tuple(a.shape))
    check_floats("the first image", a)
    check_floats("the second image", b)
    if mask is not None:
        check_tensor("mask", mask, tuple(a.shape[:2]), torch.bool)
        if not mask.any():
            raise ValueError("the mask holds no pixel, so there is nothing to compare")
