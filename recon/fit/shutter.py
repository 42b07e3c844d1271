"""Pictures whose rows were read one after the other, drawn at one go: each splat stands where it was when its row was read.

After SplatAD (Hess et al. 2025, section 3.3), which moves projected splats by their speed in the image; here their centres move in
space, so that any rasterizer draws them. A shutter of 30 ms turns or deforms no splat by as much as can be told.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from render.launch import upload
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


@torch.no_grad()
def readout_shift(
    points: torch.Tensor, first: torch.Tensor, last: torch.Tensor, camera: Camera, shutter: str, counts: list[int] | None = None
) -> torch.Tensor:
    """How far points `[N, 3]` are, from where they are at the middle row's moment, when their own row is read; else as `as_read`. counts:
    where first and last are several poses `[P, 4, 4]`, of how many of the points each is."""
    middle, travel = (0.5 * (first + last)).float(), (last - first).float()
    middle, local = (upload(m, points.device) for m in (middle[..., :3, :], middle[..., :3, :3].mT @ travel[..., :3, :]))

    def carried(by: torch.Tensor) -> torch.Tensor:
        if counts is None:
            return points @ by[:, :3].T + by[:, 3]
        return torch.cat([torch.addmm(m[:, 3], p, m[:, :3].T) for p, m in zip(points.split(counts), by, strict=True)])

    seen = carried(middle)
    ahead = seen[:, 2:] > NEAR
    axis, extent = (1, camera.height) if shutter == "rows" else (0, camera.width)
    share = camera.lens.project(torch.where(ahead, seen, 1.0))[:, axis : axis + 1] / extent
    # the row is that of the middle's moment: a splat that moves by a hundredth of the picture is off by a hundredth of that
    share = torch.where(ahead, share.clamp(0, 1) - 0.5, 0.0)
    return share * carried(local)


def shifts_of(means: list[torch.Tensor], first: torch.Tensor, last: torch.Tensor, camera: Camera, shutter: str) -> tuple[torch.Tensor, ...]:
    """`readout_shift` of several groups of points, each with poses of its own `[P, 4, 4]`."""
    if len(means) == 1:
        return (readout_shift(means[0], first[0], last[0], camera, shutter),)
    counts = [len(m) for m in means]
    return readout_shift(torch.cat(means), first, last, camera, shutter, counts).split(counts)
