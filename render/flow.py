"""Optical flow from depth: where the surface seen by a pixel stands in the other frame, and whether that frame sees it too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import warp as wp
from torch.nn import functional as F

from render.kernels.flow import carry
from render.launch import run, view
from render.projection import moves, poses
from render.rays import camera_origins, camera_rays, readout
from scenes.camera import Camera
from scenes.gaussians import Placed
from scenes.poses import inverse

HIDES = 0.05
"""What lies nearer by this share of the depth hides a point; less is the roughness of splatted surfaces."""


SECANTS = 6
"""Steps towards the moment at which a point is read out: of a point that moves by a tenth of the image meanwhile, 1e-7 is left after 3."""


@dataclass(frozen=True)
class Correspondence:
    """Each pixel's surface point in the other frame: points `[H, W, 3]` in that camera, flow `[H, W, 2]` in pixels, nan where the other
    lens does not see, pixels `[H, W, 2]` there."""

    other: Camera
    points: torch.Tensor
    flow: torch.Tensor
    pixels: torch.Tensor

    def visible(self, depth: torch.Tensor) -> torch.Tensor:
        """bool `[H, W]`: the point falls into the other image, and there `depth` `[H', W']` shows nothing nearer in all four pixels
        around it. Sky hides nothing and is hidden by all."""
        height, width = depth.shape
        corner = torch.floor(torch.nan_to_num(self.pixels, nan=-9.0).clamp(-9, 1e6) + 0.5).long()
        around = F.max_pool2d(F.pad(depth[None, None], (1, 1, 1, 1), value=-torch.inf), 2, 1)[0, 0]  # of the pixels that meet in a corner
        farthest = around[corner[..., 1].clamp(0, height), corner[..., 0].clamp(0, width)]
        size = torch.tensor([width, height], device=depth.device)
        inside = ((self.pixels >= 0) & (self.pixels <= size)).all(-1)
        return inside & (farthest >= (1 - HIDES) * self.other.lens.depth(self.points))


def correspond(
    placed: Sequence[Placed], camera: Camera, depth: torch.Tensor, instance: torch.Tensor, there: Sequence[Placed], other: Camera,
    corner: tuple[int, int] = (0, 0),
) -> Correspondence:  # fmt: skip
    """Where the surface points of `depth` and `instance` `[h, w]` stand in `other`. corner: x, y of the first pixel in `camera`'s image.

    A point lies at the pixel's depth and moves rigidly with its instance. Where nothing is drawn (instance -1) the pixel is
    sky and moves by the cameras' rotation only: its point is infinitely far. While a shutter moves, a pixel's point is that of the moment
    at which the pixel is read out, and stands in `other` where it is when the row or column in which it appears is read out there.
    """
    device = depth.device
    height, width = depth.shape
    part = (slice(corner[1], corner[1] + height), slice(corner[0], corner[0] + width))
    origins = camera_origins(camera)
    sky = depth.isinf() | (instance < 0)
    rays = camera_rays(camera)[part].to(device) * torch.where(sky, torch.ones_like(depth), depth)[..., None]
    points = (origins[part] if origins.ndim == 3 else origins).to(device) + rays
    out, pixels = _seen_in(other, points, _who(placed, instance, sky), _ways(placed, camera, there, other, part), camera.shutter)
    flow = torch.where(other.lens.valid(out)[..., None], pixels - camera.lens.project(points), torch.nan).to(torch.float32)
    pixels = torch.where(flow.isnan(), torch.nan, pixels)
    return Correspondence(other, torch.where(sky[..., None], out * torch.inf, out), flow, pixels)


def _who(placed: Sequence[Placed], instance: torch.Tensor, sky: torch.Tensor) -> torch.Tensor:
    """int32 `[H, W]`: which of `placed` a pixel shows; behind them all, the sky."""
    ids, order = torch.tensor([p.instance for p in placed], dtype=torch.int32, device=instance.device).sort()
    found = order.to(torch.int32)[torch.searchsorted(ids, instance.contiguous()).clamp(max=len(ids) - 1)]
    return found.where(~sky, len(placed))


def _ways(placed: Sequence[Placed], camera: Camera, there: Sequence[Placed], other: Camera, part: tuple[slice, slice]) -> torch.Tensor:
    """float32 `[P + 1, C, R, 4, 4]`, composed in float64: for each of `placed`, and the sky, from this camera, as each of its R rows or
    columns in `part` is read out, to the other as coefficients of the powers of its readout's share; R and C are 1 where nothing moves."""
    sky = Placed(placed[0].gaussians, torch.eye(4, dtype=torch.float64))
    moved = {p.instance: p for p in there}
    now = [*placed, sky]
    then = [*(moved.get(p.instance, replace(p, world_from_local_end=None)) for p in placed), sky]
    world_from_cam, world_from_local = camera.world_from_cam, torch.stack([p.world_from_local for p in now])[:, None]
    if moves(camera, placed):
        lines = part[1] if camera.shutter == "columns" else part[0]
        world_from_cam = readout(camera, camera.world_from_cam, camera.world_from_cam_end)[lines]
        world_from_local = torch.stack([readout(camera, p.world_from_local, p.world_from_local_end)[lines] for p in now])
    local_from_cam = inverse(world_from_local) @ world_from_cam
    ways = (poses(other, then)[:, :, None] @ local_from_cam[:, None]).detach()
    ways[-1, ..., :3, 3] = 0  # it is infinitely far: only turning moves it
    return ways.to(torch.float32)


def _seen_in(other: Camera, points: torch.Tensor, who: torch.Tensor, ways: torch.Tensor, shutter: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Points `[H, W, 3]` and pixels `[H, W, 2]` in `other` of this camera's points, by `ways` as of `_ways`."""
    ways, points = ways.to(points.device).contiguous(), points.contiguous()
    told = [view(points, wp.vec3), view(who, int), view(ways, wp.mat44), int(shutter == "columns")]

    def at(share: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        carried = torch.empty_like(points)
        run(carry, len(points), [*told, view(share.contiguous(), float), view(carried, wp.vec3)], points.device)
        return carried, other.lens.project(carried)

    before = torch.zeros_like(points[..., 0])
    if ways.shape[1] == 1:
        return at(before)
    axis, extent = (0, other.width) if other.shutter == "columns" else (1, other.height)

    def missed(share: torch.Tensor) -> torch.Tensor:
        return share - (at(share)[1][..., axis] / extent).clamp(0, 1)

    # the share s of the readout with s = pixel(s) along the axis / extent, by secants; the pixel depends on it but weakly
    share, missed_before = torch.full_like(before, 0.5), missed(before)
    for _ in range(SECANTS):
        now = missed(share)
        rise = (now - missed_before) / (share - before)
        # where the pixel runs with the shutter, or the last step was none, as if it stood still
        step = now / torch.where(torch.isfinite(rise) & (rise > 0.1), rise, torch.ones_like(rise))
        before, missed_before, share = share, now, (share - step).clamp(0, 1)
    return at(share)
