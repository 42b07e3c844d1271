"""A scene's sky behind its splats."""

from __future__ import annotations

import torch
import warp as wp

from render.kept import kept_beside
from render.kernels.sky import lay_behind
from render.launch import run, stage, upload, view
from render.rays import camera_rays, on_device, turns, world_directions
from scenes.camera import Camera
from scenes.sky import Sky, srgb_from_linear

SKY_SHOWS = 1 / 512
"""Where less light than this passes the splats, the sky changes no 8-bit value."""


def over_sky(rgb: torch.Tensor, alpha: torch.Tensor, sky: Sky, camera: Camera) -> torch.Tensor:
    """Premultiplied `rgb` `[H, W, 3]` over the sky, looked up only where `alpha` `[H, W]` lets light pass; differentiable in all three."""
    if torch.is_grad_enabled() and any(t.requires_grad for t in (rgb, alpha, sky.linear)):
        return _differentiably(rgb, alpha, sky, camera)
    if rgb.device.type == "cpu" and not (alpha < 1 - SKY_SHOWS).any():  # to ask a GPU takes longer than to look
        return rgb
    out = torch.empty(rgb.shape, dtype=torch.float32, device=rgb.device)
    ways = upload(turns(camera).to(rgb.dtype).contiguous(), rgb.device)
    with stage(rgb.device):
        args = [view(on_device(camera_rays(camera), rgb.device), wp.vec3), view(ways, wp.mat33), int(camera.shutter != "columns")]
        args += [
            view(on_device(_display(sky.linear), rgb.device), wp.vec3),
            SKY_SHOWS,
            view(rgb, float),
            view(alpha, float),
            view(out, float),
        ]
        run(lay_behind, rgb.shape[0], args, rgb.device)
    return out


@kept_beside
def _display(linear: torch.Tensor) -> torch.Tensor:
    """A sky's display-referred colours."""
    return srgb_from_linear(linear.detach()).contiguous()


def _differentiably(rgb: torch.Tensor, alpha: torch.Tensor, sky: Sky, camera: Camera) -> torch.Tensor:
    through = alpha.detach() < 1 - SKY_SHOWS
    if not through.any():
        return rgb
    directions = world_directions(camera)
    through = through & (directions != 0).any(-1).to(through.device)  # no direction leads to pixels past a lens's edge
    colour = sky.colour(directions[through.cpu()]).to(rgb)
    behind = colour * (1 - alpha[through])[..., None]
    return rgb.index_put((through,), behind, accumulate=True)
