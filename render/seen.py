"""A view from which detail is moved into another: what photos show and splats do not, by exact depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp

from render.flow import HIDES, correspond
from render.frame_types import Frame
from render.kernels.detail import Here, Other
from render.launch import run_pixels, stage, view
from scenes.camera import Camera
from scenes.gaussians import Placed

PHOTOS = 2
"""Photos that a view is given; a further one's score is where they fade to nothing."""

NOISE = 0.2
"""Error of a moved difference at no parallax, against its size: of 1 / (1 + NOISE) of it one is sure."""

PARALLAX = 0.15
"""Way from eye to eye, in distances to what is seen, that adds as much error again as the difference is large."""

GONE = -2
"""Instance of what a view shows and the frames do not."""

Part = tuple[slice, slice]
"""Rows and columns of a picture."""

WHOLE: Part = (slice(None), slice(None))


@dataclass(frozen=True)
class Seen:
    """A view from which detail is moved: its camera, the detail `[H, W, 4]` before any exposure, depth `[H, W]`, inf at the sky, instances
    `[H, W]` by the frames' ids, and what was placed there by those ids."""

    camera: Camera
    detail: torch.Tensor
    depth: torch.Tensor
    instance: torch.Tensor
    placed: list[Placed]

    @classmethod
    def of(cls, frame: Frame, detail: torch.Tensor, instance: torch.Tensor, placed: list[Placed]) -> Seen:
        """Of a frame with its detail `[H, W, 4]`."""
        assert frame.depth is not None and frame.instance is not None
        depth = torch.where(frame.instance < 0, torch.inf, frame.depth)
        return cls(frame.camera, detail.contiguous(), depth, instance.to(torch.int32), placed)


def faded(scores: torch.Tensor) -> list[tuple[int, float]]:
    """The `PHOTOS` of the highest scores `[S]`, best first, each with a share of 0 to 1 that falls to nothing as the next comes near."""
    best = scores.argsort(descending=True)[: PHOTOS + 1]
    if not len(best):
        return []
    floor = float(scores[best[PHOTOS]]) if len(best) > PHOTOS else 0.0
    room = max(float(scores[best[0]]) - floor, 1e-12)
    return [(int(i), s) for i in best[:PHOTOS] if (s := (float(scores[i]) - floor) / room) > 0]


def run_over(
    kernel: wp.Kernel, frame: Frame, placed: Sequence[Placed], clear: torch.Tensor, seen: Seen, told: list, part: Part = WHOLE
) -> None:
    """Launch a kernel of `kernels/detail.py` over a part of a frame: from the view `seen` to the pixels that are `clear`. clear, and what
    the kernel is told, are of that part alone."""
    assert frame.depth is not None and frame.instance is not None
    depth, instance = frame.depth[part].contiguous(), frame.instance[part].to(torch.int32).contiguous()
    corner = part[1].start or 0, part[0].start or 0
    found = correspond(placed, frame.camera, depth, instance, seen.placed, seen.camera, corner)
    other, here = Other(), Here()
    with stage(clear.device):
        other.detail, other.depth = wp.from_torch(seen.detail, wp.vec4), wp.from_torch(seen.depth)
        other.instance = wp.from_torch(seen.instance)
        here.pixels, here.depths = wp.from_torch(found.pixels, wp.vec2d), wp.from_torch(found.depth)
        here.instance, here.clear = wp.from_torch(instance), wp.from_torch(clear, wp.bool)
        run_pixels(kernel, clear.numel(), [other, here, HIDES, *(view(*t) if isinstance(t, tuple) else t for t in told)], clear.device)
