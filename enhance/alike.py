"""Whether two pictures show one place: cuts and jumps are known by it, and photos of a clip's own place."""

from __future__ import annotations

import torch
from torch.nn import functional as F

BLOCKS = (18, 32)
CUT = 0.5
"""Mean difference of pictures shrunk to BLOCKS, against how much those vary within themselves, from which they do not show the same place.
Measured on 480 frames of drives: up to 0.29 from a frame to the next, 0.75 and more between places."""

LONG = 160
"""Pixels of a thinned picture's longer side."""


def thin(image: torch.Tensor) -> torch.Tensor:
    """Evenly spaced pixels of `[B, C, H, W]`: the longer side LONG, both even; a small picture keeps all its pixels but an odd row's."""
    sides = image.shape[-2:]
    share = min(1.0, LONG / max(sides))
    small = [max(2, 2 * round(side * share / 2 - 0.25)) for side in sides]
    y, x = (torch.linspace(0, side - 1, n, device=image.device).round().long() for side, n in zip(sides, small, strict=True))
    return image[..., y[:, None], x]


def alike(rgb: torch.Tensor, last: torch.Tensor, seen: torch.Tensor | None = None) -> torch.Tensor:
    """Whether pictures `[B, 3, H, W]` show one place, bool `[B]`. `seen` `[B, 1, H, W]`: 1 where `last` is known, everywhere if None."""
    now, then = thin(rgb), thin(last)
    known = torch.ones_like(now[:, :1]) if seen is None else thin(seen)
    then = torch.lerp(now, then, known)
    now, then = F.adaptive_avg_pool2d(now, BLOCKS), F.adaptive_avg_pool2d(then, BLOCKS)
    apart = (now - then).abs().mean((1, 2, 3)) / known.mean((1, 2, 3)).clamp_min(1e-3)
    varies = torch.stack([(x - x.mean((2, 3), keepdim=True)).abs().mean((1, 2, 3)) for x in (now, then)]).mean(0)
    return apart < CUT * (varies + 0.02)
