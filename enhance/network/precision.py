"""Which arithmetic is fast here: bfloat16 where the processor computes in it, float32 elsewhere."""

from __future__ import annotations

from typing import TypeVar

import torch

M = TypeVar("M", bound=torch.nn.Module)


def has_bfloat16(device: torch.device) -> bool:
    """Whether bfloat16 is arithmetic and not emulation; measured 2x on AVX512-BF16 convolutions, a loss without."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    return device.type == "cpu" and torch.cpu._is_avx512_bf16_supported()


def autocast(device: torch.device):
    """Convolutions and matrix products in bfloat16 where that is fast."""
    return torch.autocast(device.type, torch.bfloat16, enabled=has_bfloat16(device))


def lower(x: torch.Tensor) -> torch.Tensor:
    """`x` in the precision that convolutions run in here, where that is not its own."""
    kind = x.device.type
    return x.to(torch.get_autocast_dtype(kind)) if torch.is_autocast_enabled(kind) else x


def channels_last(module: M) -> M:
    """The module with its convolutions' weights in the order that CPUs and tensor cores work in."""
    for parameter in module.parameters():
        if parameter.ndim == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return module
