"""What every public model is to the enhancer: frames in, one better frame out."""

from __future__ import annotations

import torch
from torch import nn


class Model(nn.Module):
    """Frames `[1, V, 3, H, W]` in 0..1, newest first, to a better first one `[1, 3, H, W]`.

    multiple  of which both sides must be
    window    rows and columns that it takes, and no others; any if None
    history   how many of its last results it takes beside the frame: all of those, or none
    left_out  what else stands in its file, and is of no use here
    takes_reference  whether a clean picture of the same place may come second
    """

    name: str
    multiple = 16
    window: tuple[int, int] | None = None
    history = 0
    takes_reference = False
    left_out: tuple[str, ...] = ()

    def forward(self, clip: torch.Tensor) -> torch.Tensor:
        raise NotImplementedError
