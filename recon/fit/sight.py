"""Which splats a picture may show: the others need not be drawn, and have no gradient."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import torch
import warp as wp

from recon.fit.model import MODEL, Splats
from recon.kernels.sight import mark
from render.cull import view_sides
from render.launch import run, stage, upload, view
from scenes.camera import Camera
from scenes.lenses import OpenCV, Pinhole

Eye = tuple[Camera, torch.Tensor, torch.Tensor]
"""A camera, and cam_from_world `[4, 4]` as the readout of its picture begins and as it ends."""


def in_sight(splats: Splats, eyes: Sequence[Eye], actors: Collection[int]) -> torch.Tensor:
    """Indices int64 `[M]`, rising, of the background's splats that one of `eyes` may see, and of all splats of the groups `actors`."""
    still, device = splats.sizes[0], splats.reach.device
    seen = torch.zeros(len(splats), dtype=torch.uint8, device=device)
    if all(isinstance(camera.lens, Pinhole | OpenCV) for camera, *_ in eyes):
        sides = upload(torch.stack([_sides(*eye) for eye in eyes]), device)
        with stage(device):
            fields = [view(splats.fields[name], wp.vec3) for name in ("means", "log_scales")]
            run(mark, still, [*fields, view(sides, wp.vec4), view(seen, wp.uint8)], device)
    else:
        seen[:still] = 1
    there = np.isin(np.arange(1, len(splats.sizes)), list(actors))
    seen[still:] = upload(torch.from_numpy(np.repeat(there.view(np.uint8), splats.sizes[1:])), device)
    return seen.nonzero()[:, 0]


def _sides(camera: Camera, first: torch.Tensor, last: torch.Tensor) -> torch.Tensor:
    """The sides of the view in the world, float32 `[2, S, 4]`: unit normal and distance."""
    return (view_sides(camera, MODEL) @ torch.stack([first, last])[:, :3]).float()
