"""Pictures whose rows were read one after the other, drawn at one go: each splat stands where it was when its row was read.

After SplatAD (Hess et al. 2025, section 3.3), which moves projected splats by their speed in the image; here their centres move in
space, so that any rasterizer draws them. A shutter of 30 ms turns or deforms no splat by as much as can be told.
"""

from __future__ import annotations

from dataclasses import replace

import torch
import warp as wp

from recon.kernels.shutter import carry
from render.launch import run, stage, upload, view
from scenes.camera import Camera
from scenes.gaussians import Gaussians

NEAR = 0.2
"""Metres in front of the camera within which nothing is moved."""


def as_read(splats: Gaussians, first: torch.Tensor, last: torch.Tensor, camera: Camera, shutter: str) -> Gaussians:
    """Splats where they were when their row was read, if the middle row's moment is drawn. How far they move counts as given: nothing
    is differentiated through it.

    first, last: cam_from_local `[4, 4]` when the first and the last row (column) of `camera` is read.
    """
    return replace(splats, means=splats.means + readout_shift(splats.means, first, last, camera, shutter))


def readout_shift(points: torch.Tensor, first: torch.Tensor, last: torch.Tensor, camera: Camera, shutter: str) -> torch.Tensor:
    """How far points `[N, 3]` are, from where they are at the middle row's moment, when their own row is read; else as `as_read`."""
    return readout_shifts(points, [len(points)], first[None], last[None], camera, shutter)


@torch.no_grad()
def readout_shifts(
    points: torch.Tensor, counts: list[int], first: torch.Tensor, last: torch.Tensor, camera: Camera, shutter: str
) -> torch.Tensor:
    """The same of several groups of points, so many each, with poses of their own `[P, 4, 4]`."""
    device = points.device
    middle, travel = (0.5 * (first + last)).float(), (last - first).float()
    by = upload(torch.cat([middle, middle[:, :3, :3].mT @ travel[:, :3]], 1), device)
    ends = upload(torch.tensor(counts).cumsum(0, dtype=torch.int32), device)
    seen, moved = torch.empty(2, *points.shape, device=device)
    with stage(device):
        args = [view(points.contiguous(), wp.vec3), view(ends, int), view(by, float), NEAR, view(seen, wp.vec3), view(moved, wp.vec3)]
        run(carry, len(points), args, device)
    axis, extent = (1, camera.height) if shutter == "rows" else (0, camera.width)
    share = camera.lens.project(seen)[:, axis : axis + 1] / extent
    # the row is that of the middle's moment: a splat that moves by a hundredth of the picture is off by a hundredth of that
    return (share.clamp(0, 1) - 0.5) * moved
