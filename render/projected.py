"""What compositing is given, all splats on the image, and what it leaves for backward of each window."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from render.kernels.types import Window
from render.order import TileLists


@dataclass(frozen=True)
class Projected:
    """All splats on the image: records `[N, RECORD]`, their slopes `[N, 2]` (`kernels.types.ALONG`; none where no depth is wanted), reach
    int32 `[N, REACH_INTS]` (`kernels.bin`), counts int32 `[N]` of tiles at most, the visible ones' order, features `[N, C]`; where pixels
    look along their own rays, float64 canonical frames `[N, FRAME]` (`ray_rows.py`) and rays `[G, C, H, W]` (`rays.py`)."""

    records: torch.Tensor
    slopes: torch.Tensor
    reach: torch.Tensor
    counts: torch.Tensor
    order: torch.Tensor
    features: torch.Tensor | None
    frames: torch.Tensor | None = None
    rays: torch.Tensor | None = None

    @property
    def channels(self) -> int:
        return 0 if self.features is None else self.features.shape[1]


@dataclass
class Part:
    """A window of the image, as drawn: its lists and their exact counts (None where backward shall make them again, to save memory),
    where compositing ended, and its planes, of which backward reads the final transmittance."""

    window: Window
    lists: TileLists | None
    counts: torch.Tensor | None
    ends: tuple[torch.Tensor, ...]
    planes: torch.Tensor
