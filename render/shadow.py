"""Shadows of inserted assets: of the sun and of the sky, on the ground and on what stands beside them.

The light is that of the scene's sky (scenes/light.py), less what the houses and trees around keep off. How much of it an asset keeps from
the places around it is traced once (render/occlusion.py); a frame only looks it up, where the camera sees those places. For the ground
that is where a pixel's ray meets the plane that the asset stands on, since the depth of splatted asphalt is rough; the rendered depth
says what the pixel sees. Light is taken away in linear light, whatever the surface.

Inserted assets are those with `inserted` in their meta, or `edited`; other recorded actors keep the shadows of their photos.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch

from render.frame_types import Frame
from render.occlusion import Box, Field, shadow_box, squares, trace_field
from render.rays import camera_rays
from render.tracer import Blockers
from scenes.asset import Actor
from scenes.camera import Camera
from scenes.light import light_of
from scenes.poses import inverse, yaw, yaw_of
from scenes.scene import Scene
from scenes.sky import linear_from_srgb, srgb_from_linear

GROUND = 0.3
"""Metres around the plane within which a surface is the ground: asphalt, a kerb."""

SKIRT = 0.25
"""Of the asset itself only what is lower receives some: tyres, and the rim of asphalt that was cut out with it."""

TURN = math.radians(3)
"""Turn of an asset from which its shadow is traced anew."""

STEP = 6.0
"""Metres of its way from which it is asked anew what houses and trees keep off."""

AROUND = 80.0
"""Metres within which houses and trees keep light off."""


@dataclass(frozen=True)
class Caster:
    """A shadow in the view: instance id, `asset_from_cam` `[4, 4]`, the pixels `x0, y0, x1, y1` that it can fall into, half the
    asset's length and width `[2]`, and what it keeps off."""

    instance: int
    asset_from_cam: torch.Tensor
    window: tuple[int, int, int, int]
    half: torch.Tensor
    field: Callable[[], Field]


def shadow_casters(scene: Scene, camera: Camera) -> list[Caster]:
    """The inserted assets whose shadow can fall into the view."""
    found = []
    for i, actor in enumerate(scene.actors):
        if not _placed_anew(actor) or not actor.trajectory.covers(camera.time_us):
            continue
        pose, shade = actor.trajectory.at(camera.time_us), _shade(scene)
        directions, weights = shade.at(actor, pose)
        box = shadow_box(actor.asset.size, directions[weights > 0])
        asset_from_cam = inverse(pose) @ camera.world_from_cam.detach()
        window = _window(asset_from_cam, box, camera)
        if window is not None:
            field = partial(shade.field, actor, box, directions, weights)
            found.append(Caster(i + 1, asset_from_cam, window, actor.asset.size[:2] / 2, field))
    return found


def cast(frame: Frame, casters: list[Caster]) -> torch.Tensor:
    """The frame's rgb `[H, W, 3]`, darkened by the casters; needs rgb, depth and instance. Only their windows are touched."""
    assert frame.rgb is not None and frame.depth is not None and frame.instance is not None
    rgb = frame.rgb.clone()
    for caster in casters:
        x0, y0, x1, y1 = caster.window
        depth = frame.depth[y0:y1, x0:x1].detach()
        pose = caster.asset_from_cam.to(depth.device, torch.float32)
        rays = camera_rays(frame.camera)[y0:y1, x0:x1].to(depth.device) @ pose[:3, :3].T
        down = rays[..., 2:].clamp_max(-1e-6)  # rays that rise never meet the plane: their point lies far off, where no shadow is
        plane = pose[:3, 3] - (pose[2, 3] / down) * rays
        seen = pose[:3, 3] + torch.where(torch.isfinite(depth), depth, torch.zeros_like(depth))[..., None] * rays
        height = seen[..., 2]
        # within the footprint the depth mixes the asset with the ground that shows through it
        own = (frame.instance[y0:y1, x0:x1] == caster.instance) | ((seen[..., :2].abs() < caster.half.to(seen)).all(-1) & (height > 0.1))
        field = caster.field()
        blocked = field.at(torch.where((own | (height < GROUND))[..., None], plane, seen))
        receives = torch.where(own, _smooth(1 - height / SKIRT), torch.ones_like(height)) * torch.isfinite(depth)
        light = (1 - receives * blocked)[..., None].to(rgb)
        # without a shadow nothing is changed, not even by rounding
        part = rgb[y0:y1, x0:x1]
        rgb[y0:y1, x0:x1] = torch.where(light < 1, srgb_from_linear(linear_from_srgb(part) * light), part)
    return rgb


def _placed_anew(actor: Actor) -> bool:
    """Whether it stands where no photo shows its shadow."""
    return bool(actor.asset.meta.get("inserted") or actor.asset.meta.get("edited"))


class Shade:
    """The light of one scene, and what its assets keep off, traced when first asked for."""

    def __init__(self, scene: Scene):
        self.scene, self.light = scene, light_of(scene)
        self._houses: Blockers | None = None
        self._passing: dict[tuple[int, ...], torch.Tensor] = {}
        self._fields: dict[tuple, Field] = {}

    def at(self, actor: Actor, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Directions `[K, 3]` of the light in the frame of an actor at a pose, and how much of each `[K]` reaches that place."""
        place = tuple((pose[:3, 3] / STEP).round().int().tolist())
        if place not in self._passing:
            self._passing[place] = self._pass(pose, actor.asset.size)
        # the asset's tilt is left out: the ground that is shaded tilts along
        turned = yaw(-TURN * round(float(yaw_of(pose)) / TURN))[:3, :3]
        return (self.light.directions @ turned.T).float(), self._passing[place]

    def field(self, actor: Actor, box: Box, directions: torch.Tensor, weights: torch.Tensor) -> Field:
        """What an actor keeps off in a box of its frame."""
        key = (actor.track, directions.numpy().tobytes(), weights.numpy().tobytes())
        if key not in self._fields:
            self._fields[key] = trace_field(actor.asset.gaussians.detach().to("cpu"), box, directions, weights)
        return self._fields[key]

    def _pass(self, pose: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
        """The part `[K]` of the light from each direction that houses and trees let pass to just above an asset."""
        background = self.scene.background
        if self._houses is None:
            self._houses = Blockers(squares(background.gaussians.detach().to("cpu")))
        length, width, height = size.tolist()
        spots = [[0, 0], [length / 2, width / 2], [-length / 2, width / 2], [length / 2, -width / 2], [-length / 2, -width / 2]]
        points = torch.tensor([[x, y, height + 0.3] for x, y in spots], dtype=torch.float64)
        local_from_asset = inverse(background.world_from_local) @ pose
        points = points @ local_from_asset[:3, :3].T + local_from_asset[:3, 3]
        turned = self.light.directions @ inverse(background.world_from_local)[:3, :3].T
        each = torch.eye(len(turned))
        passing = torch.stack([self._houses.open_share(points, turned, one, AROUND).mean() for one in each])
        return passing if bool((passing > 0).any()) else torch.ones(len(turned))  # under a bridge any light will do


_last: list[Shade] = []


def _shade(scene: Scene) -> Shade:
    """The shade of a scene; that of the last one asked for is kept, since a clip asks frame by frame."""
    if not _last or _last[0].scene is not scene:
        _last[:] = [Shade(scene)]
    return _last[0]


def _smooth(u: torch.Tensor) -> torch.Tensor:
    u = u.clamp(0, 1)
    return u * u * (3 - 2 * u)


def _window(asset_from_cam: torch.Tensor, box: Box, camera: Camera) -> tuple[int, int, int, int] | None:
    """Pixels that a box projects into; None where that is outside the image or the ground is seen from below."""
    if not asset_from_cam[2, 3] > 0:
        return None
    cam_from_asset = inverse(asset_from_cam)
    seen = box.corners() @ cam_from_asset[:3, :3].T + cam_from_asset[:3, 3]
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
