"""Optical flow from depth: where the surface seen by a pixel stands in the other frame, and whether that frame sees it too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
import warp as wp

from render.kernels.flow import carry_kernel, see
from render.kernels.lenses import LENS_FUNCTIONS
from render.launch import run_pixels, stage, view
from render.projection import moves, optics_of, poses
from render.rays import camera_origins, camera_rays, on_device, readout
from scenes.camera import Camera
from scenes.gaussians import Placed
from scenes.poses import inverse

HIDES = 0.05
"""What lies nearer by this share of the depth hides a point; less is the roughness of splatted surfaces."""


SECANTS = 6
"""Steps towards the moment at which a point is read out: of a point that moves by a tenth of the image meanwhile, 1e-7 is left after 3."""


@dataclass(frozen=True)
class Correspondence:
    """Each pixel's surface point in the other frame: flow float32 `[H, W, 2]` in pixels and pixels float64 `[H, W, 2]` there, nan where
    the other lens does not see, and its depth there `[H, W]`, inf for the sky."""

    flow: torch.Tensor
    pixels: torch.Tensor
    depth: torch.Tensor

    def visible(self, depth: torch.Tensor) -> torch.Tensor:
        """bool `[H, W]`: the point falls into the other image, and there `depth` `[H', W']` shows nothing nearer in all four pixels
        around it. Sky hides nothing and is hidden by all."""
        seen = torch.empty(self.depth.shape, dtype=torch.bool, device=self.depth.device)
        with stage(depth.device):
            told = [view(self.pixels, wp.vec2d), view(self.depth, float), HIDES, view(depth.contiguous(), float), view(seen, wp.bool)]
            run_pixels(see, seen.numel(), told, depth.device)
        return seen


def correspond(
    placed: Sequence[Placed], camera: Camera, depth: torch.Tensor, instance: torch.Tensor, there: Sequence[Placed], other: Camera,
    corner: tuple[int, int] = (0, 0),
) -> Correspondence:  # fmt: skip
    """Where the surface points of `depth` and `instance` `[h, w]` stand in `other`. corner: x, y of the first pixel in `camera`'s image.

    A point lies at the pixel's depth and moves with its instance, by what its lattices say where that deforms. Where nothing is drawn
    (instance -1) the pixel is sky and moves by the cameras' rotation only: its point is infinitely far. While a shutter moves, a pixel's
    point is that of the moment at which the pixel is read out, and stands in `other` where it is when the row or column in which it appears
    is read out there; what deforms is taken as in the middle of either readout.
    """
    device = depth.device
    height, width = depth.shape
    part = (slice(corner[1], corner[1] + height), slice(corner[0], corner[0] + width))
    origins = camera_origins(camera)
    ways = _ways(placed, camera, there, other, part).to(device)
    rays = camera_rays(camera)
    bends = _bends(placed, camera, depth, instance, there, rays[part], origins if origins.ndim == 1 else origins[part])
    pixels = torch.empty(height, width, 2, dtype=torch.float64, device=device)
    flow, far = (torch.empty(height, width, *more, dtype=torch.float32, device=device) for more in ((2,), ()))
    found = Correspondence(flow, pixels, far)
    tensors = [
        (on_device(rays, device), wp.vec3), (origins if origins.ndim == 3 else origins[None, None], wp.vec3), *corner, (bends, wp.vec3),
        (depth.detach(), float), (instance.to(torch.int32), int), (_places(placed, device), int), (ways, wp.mat44d),
        int(camera.shutter == "columns"),
    ]  # fmt: skip
    kept = [(t[0].to(device).contiguous(), t[1]) if isinstance(t, tuple) else t for t in tensors]
    with stage(device):
        told = [view(*t) if isinstance(t, tuple) else t for t in kept]
        results = [view(found.pixels, wp.vec2d), view(found.flow, wp.vec2), view(found.depth, float)]
        kernel, optics = carry_kernel(LENS_FUNCTIONS[other.lens.kind]), optics_of(other.lens, other.width)

        def carried(share: torch.Tensor) -> torch.Tensor:
            run_pixels(kernel, depth.numel(), [*told, view(share, wp.float64), optics, *results], device)
            return found.pixels

        if ways.shape[1] == 1:
            carried(torch.zeros(1, 1, dtype=torch.float64, device=device))  # nobody asks for the share
        else:
            _read_out(carried, other, torch.zeros_like(pixels[..., 0]))
    return found


def _places(placed: Sequence[Placed], device: torch.device) -> torch.Tensor:
    """int32: by instance, from -1, which of `placed` it is."""
    places = torch.zeros(max(p.instance for p in placed) + 2, dtype=torch.int32)
    for i, p in enumerate(placed):
        places[p.instance + 1] = i
    return places.to(device)


def _ways(placed: Sequence[Placed], camera: Camera, there: Sequence[Placed], other: Camera, part: tuple[slice, slice]) -> torch.Tensor:
    """float64 `[P + 1, C, R, 4, 4]`: for each of `placed`, and the sky, from this camera, as each of its R rows or
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
    return ways


def _bends(
    placed: Sequence[Placed], camera: Camera, depth: torch.Tensor, instance: torch.Tensor, there: Sequence[Placed], rays: torch.Tensor,
    origins: torch.Tensor,
) -> torch.Tensor:  # fmt: skip
    """How far each pixel's point moves within its instance from here to there, in this camera's frame as its first row is read; float32
    `[h, w, 3]`, `[1, 1, 3]` where nothing deforms."""
    moved = {p.instance: p.lattice for p in there}
    bent = [(p, moved[p.instance]) for p in placed if p.instance in moved and not (p.lattice is None and moved[p.instance] is None)]
    if not bent:
        return torch.zeros(1, 1, 3, dtype=torch.float32)
    out = torch.zeros(*depth.shape, 3, dtype=torch.float32, device=depth.device)
    for p, then in bent:
        mine = (instance == p.instance) & torch.isfinite(depth)
        here = mine.to(rays.device)
        points = depth[mine][:, None] * rays[here].to(depth) + (origins if origins.ndim == 1 else origins[here]).to(depth)
        turn = (inverse(p.world_from_local.detach()) @ camera.world_from_cam.detach()).to(depth)
        now = points @ turn[:3, :3].T + turn[:3, 3]
        before = now if p.lattice is None else p.lattice.origin(now)
        after = before if then is None else before + then.at(before)
        out[mine] = (after - now).detach() @ turn[:3, :3]
    return out


def _read_out(carried: Callable[[torch.Tensor], torch.Tensor], other: Camera, share: torch.Tensor) -> None:
    """Carry points to where they stand when `other`, which moves meanwhile, reads them out. carried: pixels `[H, W, 2]` at shares of the
    readout `[H, W]`, which `share` is at first."""
    at = carried(share)
    axis, extent = (0, other.width) if other.shutter == "columns" else (1, other.height)

    def missed(share: torch.Tensor) -> torch.Tensor:
        return share - (carried(share)[..., axis] / extent).clamp(0, 1)

    # the share s of the readout with s = pixel(s) along the axis / extent, by secants; the pixel depends on it but weakly
    before, missed_before = share, share - (at[..., axis] / extent).clamp(0, 1)
    share = torch.full_like(before, 0.5)
    for _ in range(SECANTS):
        now = missed(share)
        rise = (now - missed_before) / (share - before)
        # where the pixel runs with the shutter, or the last step was none, as if it stood still
        step = now / torch.where(torch.isfinite(rise) & (rise > 0.1), rise, torch.ones_like(rise))
        before, missed_before, share = share, now, (share - step).clamp(0, 1)
    carried(share)
