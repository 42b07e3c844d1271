"""A first contact shadow: inserted assets darken the ground below and beside them, softly, by their footprint.

No light is traced. What a rough sky does under a car is near enough a function of the distance to its footprint:
dark underneath, fading over about the height of the body's underside above the ground (an ambient-occlusion look).
Where a pixel's ray meets the plane that the asset stands on says how dark; the rendered depth only says whether that
plane is what the pixel sees, with much tolerance, since the depth of splatted asphalt is rough.
Inserted assets are those with `inserted` in their meta, or `edited`; other recorded actors keep the shadows of their photos.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from render.frame_types import Frame
from render.rays import camera_rays
from scenes.asset import Actor
from scenes.camera import Camera
from scenes.poses import inverse
from scenes.scene import Scene

DARKNESS = 0.62  # how much of the light the middle of a footprint loses
REACH = 0.55  # metres beside the footprint at which the shadow has gone
INSET = 0.35  # metres inside the footprint's edge at which it is full
RECEIVES = 0.3  # surfaces up to so many metres above the plane receive all of it: asphalt, a kerb
CEILING = 0.8  # and those from here on none: other cars, people
SKIRT = 0.35  # of the asset itself only what is lower receives some: tyres, and the rim of asphalt that was cut out with it


@dataclass(frozen=True)
class Caster:
    """A footprint in the view: instance id, `asset_from_cam` `[4, 4]`, half length and width in metres, and the pixels
    `x0, y0, x1, y1` that its shadow can fall into."""

    instance: int
    asset_from_cam: torch.Tensor
    half: tuple[float, float]
    window: tuple[int, int, int, int]


def shadow_casters(scene: Scene, camera: Camera) -> list[Caster]:
    """The inserted assets whose shadow can fall into the view."""
    found = []
    for i, actor in enumerate(scene.actors):
        if not _placed_anew(actor) or not actor.trajectory.covers(camera.time_us):
            continue
        asset_from_cam = inverse(actor.trajectory.at(camera.time_us)) @ camera.world_from_cam.detach()
        half = (float(actor.asset.size[0]) / 2, float(actor.asset.size[1]) / 2)
        window = _window(asset_from_cam, half, camera)
        if window is not None:
            found.append(Caster(i + 1, asset_from_cam, half, window))
    return found


def _placed_anew(actor: Actor) -> bool:
    """Whether it stands where no photo shows its shadow."""
    return bool(actor.asset.meta.get("inserted") or actor.asset.meta.get("edited"))


def cast(frame: Frame, casters: list[Caster]) -> torch.Tensor:
    """The frame's rgb `[H, W, 3]`, darkened by the casters; needs rgb, depth and instance. Only their windows are touched."""
    assert frame.rgb is not None and frame.depth is not None and frame.instance is not None
    rgb = frame.rgb.clone()
    for caster in casters:
        x0, y0, x1, y1 = caster.window
        depth = frame.depth[y0:y1, x0:x1].detach()
        pose = caster.asset_from_cam.to(depth.device, torch.float32)
        rays = camera_rays(frame.camera)[y0:y1, x0:x1].to(depth.device) @ pose[:3, :3].T
        down = rays[..., 2].clamp_max(-1e-6)  # rays that rise never meet the plane: their point lies far off, where no shadow is
        plane = pose[:2, 3] - (pose[2, 3] / down)[..., None] * rays[..., :2]
        height = pose[2, 3] + torch.where(torch.isfinite(depth), depth, torch.zeros_like(depth)) * rays[..., 2]
        own = frame.instance[y0:y1, x0:x1] == caster.instance
        receives = torch.where(own, _smooth(1 - height / SKIRT), _smooth((CEILING - height) / (CEILING - RECEIVES)))
        rgb[y0:y1, x0:x1] *= (1 - receives * shade_at(plane, caster.half))[..., None].to(rgb)
    return rgb


def shade_at(points: torch.Tensor, half: tuple[float, float]) -> torch.Tensor:
    """The share of light `[...]` that points `[..., 2]` on the asset's plane lose to a footprint of that half length and width."""
    beside = points.abs() - torch.tensor(half, dtype=points.dtype, device=points.device)
    # signed distance to the rectangle: negative inside
    distance = beside.clamp_min(0).norm(dim=-1) + beside.amax(-1).clamp_max(0)
    return DARKNESS * _smooth((REACH - distance) / (REACH + INSET))


def _smooth(u: torch.Tensor) -> torch.Tensor:
    u = u.clamp(0, 1)
    return u * u * (3 - 2 * u)


def _window(asset_from_cam: torch.Tensor, half: tuple[float, float], camera: Camera) -> tuple[int, int, int, int] | None:
    """Pixels that the footprint's reach projects into; None where that is outside the image or seen from below."""
    if not asset_from_cam[2, 3] > 0:
        return None
    x, y = half[0] + REACH, half[1] + REACH
    corners = torch.tensor([[a * x, b * y, 0.0] for a in (-1, 1) for b in (-1, 1)], dtype=torch.float64)
    cam_from_asset = inverse(asset_from_cam)
    seen = corners @ cam_from_asset[:3, :3].T + cam_from_asset[:3, 3]
    if not (seen[:, 2] > 0).any():
        return None
    if (seen[:, 2] > 0.1).all():
        pixels = camera.lens.project(seen)
        low, high = pixels.amin(0).floor(), pixels.amax(0).ceil()
    else:  # it reaches past the camera plane, where projected corners bound nothing
        low, high = torch.zeros(2), torch.tensor([camera.width, camera.height])
    x0, y0 = (int(v) for v in low.clamp_min(0))
    x1, y1 = min(int(high[0]), camera.width), min(int(high[1]), camera.height)
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None
