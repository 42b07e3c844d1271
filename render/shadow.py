"""A first contact shadow: inserted assets darken the ground below and beside them, softly, by their footprint.

No light is traced. What a rough sky does under a car is near enough a function of the distance to its footprint:
dark underneath, fading over about half the height of the body's underside above the ground (an ambient-occlusion
look). Inserted assets are those with `inserted` in their meta; recorded actors keep the shadows of their photos.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from render.frame_types import Frame
from render.rays import camera_rays
from scenes.camera import Camera
from scenes.poses import inverse
from scenes.scene import Scene

DARKNESS = 0.62  # how much of the light the middle of a footprint loses
REACH = 0.55  # metres beside the footprint at which the shadow has gone
INSET = 0.35  # metres inside the footprint's edge at which it is full
CEILING = 0.3  # metres above the asset's base up to which surfaces receive it; a kerb does, a house front does not


@dataclass(frozen=True)
class Caster:
    """A footprint in the view: instance id, `asset_from_world` `[4, 4]`, and half length and width in metres."""

    instance: int
    asset_from_world: torch.Tensor
    half: tuple[float, float]
    window: tuple[int, int, int, int]


def shadow_casters(scene: Scene, camera: Camera) -> list[Caster]:
    """The inserted assets whose shadow can fall into the view, with the pixel window `x0, y0, x1, y1` it falls into."""
    found = []
    for i, actor in enumerate(scene.actors):
        if not actor.asset.meta.get("inserted") or not actor.trajectory.covers(camera.time_us):
            continue
        world_from_asset = actor.trajectory.at(camera.time_us)
        half = (float(actor.asset.size[0]) / 2, float(actor.asset.size[1]) / 2)
        window = _window(world_from_asset, half, camera)
        if window is not None:
            found.append(Caster(i + 1, inverse(world_from_asset), half, window))
    return found


def cast(frame: Frame, casters: list[Caster]) -> torch.Tensor:
    """The frame's rgb `[H, W, 3]`, darkened by the casters; needs rgb, depth and instance. Only their windows are touched."""
    assert frame.rgb is not None and frame.depth is not None and frame.instance is not None
    camera, rgb = frame.camera, frame.rgb.clone()
    for caster in casters:
        x0, y0, x1, y1 = caster.window
        receives = frame.instance[y0:y1, x0:x1] != caster.instance
        depth = frame.depth[y0:y1, x0:x1].detach()
        receives &= torch.isfinite(depth)
        rows, columns = receives.nonzero(as_tuple=True)
        rays = camera_rays(camera)[y0:y1, x0:x1].to(depth.device)[rows, columns]
        asset_from_cam = (caster.asset_from_world @ camera.world_from_cam).to(depth.device, torch.float32)
        points = (rays * depth[rows, columns, None]) @ asset_from_cam[:3, :3].T + asset_from_cam[:3, 3]
        light = rgb.new_ones(y1 - y0, x1 - x0)
        light[rows, columns] = 1 - shade_at(points, caster.half).to(rgb)
        rgb[y0:y1, x0:x1] *= light[..., None]
    return rgb


def shade_at(points: torch.Tensor, half: tuple[float, float]) -> torch.Tensor:
    """The share of light `[...]` that points `[..., 3]` in the asset's frame lose to a footprint of that half size."""
    beside = points[..., :2].abs() - torch.tensor(half, dtype=points.dtype, device=points.device)
    # signed distance to the rectangle: negative inside
    distance = beside.clamp_min(0).norm(dim=-1) + beside.amax(-1).clamp_max(0)
    near = _smooth((REACH - distance) / (REACH + INSET))
    low = _smooth((CEILING - points[..., 2].abs()) / (CEILING / 2))
    return DARKNESS * near * low


def _smooth(u: torch.Tensor) -> torch.Tensor:
    u = u.clamp(0, 1)
    return u * u * (3 - 2 * u)


def _window(world_from_asset: torch.Tensor, half: tuple[float, float], camera: Camera) -> tuple[int, int, int, int] | None:
    """Pixels that the footprint's reach projects into; None where that is outside the image or behind the camera."""
    x, y = half[0] + REACH, half[1] + REACH
    corners = torch.tensor([[a * x, b * y, c * CEILING] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)], dtype=torch.float64)
    cam_from_asset = inverse(camera.world_from_cam) @ world_from_asset
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
