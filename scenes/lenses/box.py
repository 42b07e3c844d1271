"""What an image shows of the plane z = 1."""

from __future__ import annotations

import math
from functools import lru_cache

import torch

from scenes.lenses.lens import Lens
from scenes.lenses.pinhole import Pinhole

_ALONG = 33
"""Points looked at along each edge of the image."""


def view_box(lens: Lens, width: int, height: int, margin: float = 0.0) -> tuple[float, float, float, float]:
    """Left, right, top and bottom of the image widened by `margin` pixels, as x/z and y/z, of a lens that sees what lies before it.

    Where the lens's domain ends within the image the box ends there.
    """
    if isinstance(lens, Pinhole):
        fx, fy, cx, cy = lens.params().tolist()
        return -(cx + margin) / fx, (width - cx + margin) / fx, -(cy + margin) / fy, (height - cy + margin) / fy
    return _box(lens.key(), width, height, margin)


@lru_cache(maxsize=64)
def _box(key: tuple, width: int, height: int, margin: float) -> tuple[float, float, float, float]:
    lens = key[0](*key[1:])
    x = torch.linspace(-margin, width + margin, _ALONG, dtype=torch.float64)
    y = torch.linspace(-margin, height + margin, _ALONG, dtype=torch.float64)
    edges = [(x, x * 0 - margin), (x, x * 0 + height + margin), (y * 0 - margin, y), (y * 0 + width + margin, y)]
    pixels = torch.cat([torch.stack(edge, -1) for edge in edges])
    rays = lens.unproject(pixels)
    outward = pixels - torch.tensor([float(lens.cx), float(lens.cy)], dtype=torch.float64)
    last = math.tan(lens.limit()) * outward / outward.norm(dim=-1, keepdim=True)
    n = torch.where(rays[:, 2:] > 0, rays[:, :2], last)
    (left, top), (right, bottom) = n.amin(0).tolist(), n.amax(0).tolist()
    return left, right, top, bottom
