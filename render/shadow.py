"""Shadows of inserted assets: of the sun and of the sky, on the ground and on what stands beside them.

The light is that of the scene's sky (scenes/light.py), less what the houses and trees around keep off. How much of it an asset keeps from
the places around it is traced once (render/occlusion.py); a frame only looks it up, where the camera sees those places. For the ground
that is where a pixel's ray meets the plane that the asset stands on, since the depth of splatted asphalt is rough; the rendered depth
says what the pixel sees. Light is taken away in linear light, whatever the surface.

Inserted assets are those with `inserted` in their meta, or `edited`; other recorded actors keep the shadows of their photos, and edited
ones those that came along with them (scenes/shade.py).
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
import warp as wp

from render.frame_types import Frame
from render.kernels.shadow import Falling, fall
from render.launch import run, stage, upload, view
from render.occlusion import Box, Field, shadow_box, squares, trace_field
from render.rays import camera_origins, camera_rays, on_device, readout
from render.tracer import Blockers
from scenes.asset import Actor
from scenes.camera import Camera
from scenes.gaussians import Placed
from scenes.lenses import Orthographic
from scenes.light import light_of
from scenes.poses import inverse, yaw, yaw_of
from scenes.scene import Scene, end_pose
from scenes.shade import has_shade
from scenes.sky import linear_from_srgb, srgb_from_linear
from scenes.trajectory import Trajectory

GROUND = 0.3
"""Metres around the plane within which a surface is the ground: asphalt, a kerb."""

SKIRT = 0.25
"""Of the asset itself only what is lower receives some: tyres, and the rim of asphalt that was cut out with it."""

TURN, TILT = math.radians(3), math.radians(1.5)
"""Turn and tilt of an asset from which its shadow is traced anew: uphill and downhill shadows differ more than sideways ones."""

GRAZING = 0.05
"""Of light that comes over level ground less steeply than this (sine) slopes are taken to get as much as of light that does."""

STEP = 6.0
"""Metres of an asset's way after which it is asked anew what houses and trees keep off."""

TOLD = 16
"""Casters of which is asked how much of each pixel they are: each costs a channel."""

AROUND = 80.0
"""Metres within which houses and trees keep light off."""

ALONG = 33
"""Places along each edge of a shadow's box that are projected: lenses bend straight edges."""

MOMENTS = 9
"""Of a readout at which a shadow's box is projected."""


@dataclass(frozen=True)
class Caster:
    """A shadow in the view: instance id, `asset_from_cam` `[N, 4, 4]`, one or one for each row or column as it is read out, the pixels
    `x0, y0, x1, y1` that it can fall into, half the asset's length and width `[2]`, and what it keeps off."""

    instance: int
    asset_from_cam: torch.Tensor
    window: tuple[int, int, int, int]
    half: torch.Tensor
    field: Callable[[], Field]


def shadow_casters(scene: Scene, camera: Camera) -> list[Caster]:
    """The inserted assets whose shadow can fall into the view, first those into most of it."""
    found = []
    for i, actor in enumerate(scene.actors):
        if not actor.anew or not actor.trajectory.covers(camera.time_us):
            continue
        shade = _shade(scene)
        if shade.is_brought(actor):
            continue
        directions, weights = shade.at(actor, camera.time_us)
        if not (weights > 0).any():
            continue  # the slope turns away from all the light there is
        box = shadow_box(actor.asset.size, directions[weights > 0])
        asset_from_cam = _asset_from_cam(actor, camera)
        window = _window(asset_from_cam, box, camera)
        if window is not None:
            field = partial(shade.field, actor, box, directions, weights)
            found.append(Caster(i + 1, asset_from_cam, window, actor.asset.size[:2] / 2, field))
    return sorted(found, key=lambda c: (c.window[0] - c.window[2]) * (c.window[3] - c.window[1]))


def caster_fields(casters: list[Caster], placed: Sequence[Placed]) -> list[torch.Tensor]:
    """By placed instance `[N, C]`: 1 of the splats of each of the first `TOLD` casters. Summed up over a pixel: how much of it that is."""
    which = torch.tensor([caster.instance for caster in casters[:TOLD]])
    return [upload((which == p.instance).float(), p.gaussians.device).expand(len(p.gaussians), -1) for p in placed]


def cast(frame: Frame, casters: list[Caster], shares: torch.Tensor | None = None) -> torch.Tensor:
    """The frame's rgb `[H, W, 3]`, darkened by the casters; needs rgb, depth and instance. Only what is in shadow is touched.

    shares: `[H, W, C]`, the part of each pixel's alpha that each of the first C casters is; of the others all or nothing, by instance.
    """
    assert frame.rgb is not None and frame.depth is not None and frame.instance is not None
    rgb = frame.rgb.clone()
    for i, caster in enumerate(casters):
        told = shares is not None and i < shares.shape[-1]
        own = shares[..., i] if shares is not None and told else (frame.instance == caster.instance).float()
        light = _light(frame, caster, own)
        y, x = (light < 1).nonzero().unbind(1)
        light = light[y, x, None]
        y, x = y + caster.window[1], x + caster.window[0]
        rgb[y, x] = srgb_from_linear(linear_from_srgb(rgb[y, x]) * light)
    return rgb


def _light(frame: Frame, caster: Caster, own: torch.Tensor) -> torch.Tensor:
    """What a caster leaves of the light that falls on what each pixel of its window shows. own: `[H, W]`, how much of that it is itself."""
    assert frame.depth is not None and frame.instance is not None
    x0, y0, x1, y1 = caster.window
    field, device = caster.field(), frame.depth.device
    told = Falling()
    told.instance, told.by_columns = caster.instance, int(frame.camera.shutter == "columns")
    told.half, told.ground, told.skirt = wp.vec2(*caster.half.tolist()), GROUND, SKIRT
    told.low, told.high = wp.vec3(*field.box.low.tolist()), wp.vec3(*field.box.high.tolist())
    light = torch.empty(y1 - y0, x1 - x0, dtype=torch.float32, device=device)
    poses, blocked = upload(caster.asset_from_cam.float(), device).contiguous(), field.blocked.to(device).contiguous()
    rays, origins = (on_device(of(frame.camera), device) for of in (camera_rays, camera_origins))
    origins = origins if origins.ndim == 3 else origins[None, None]
    depth, instance = frame.depth.detach().contiguous(), frame.instance.contiguous()
    with stage(device):
        seen = [
            view(rays, wp.vec3),
            view(origins, wp.vec3),
            view(depth, float),
            view(instance, int),
            view(own.detach().contiguous(), float),
            x0,
            y0,
            view(light, float),
        ]
        run(fall, light.numel(), [told, view(poses, wp.mat44), view(blocked, float), *seen], device)
    return light


class Shade:
    """The light of one scene, and what its assets keep off, traced when first asked for."""

    def __init__(self, scene: Scene):
        self.background, self.light = scene.background, light_of(scene)
        self._houses: Blockers | None = None
        self._brought: dict[str, bool] = {}
        self._passing: dict[tuple[str, int], torch.Tensor] = {}
        self._fields: dict[tuple, Field] = {}

    def is_brought(self, actor: Actor) -> bool:
        """Whether an actor's own splats hold the light that it keeps from the ground (`scenes/shade.py`)."""
        if actor.track not in self._brought:
            self._brought[actor.track] = has_shade(actor.asset)
        return self._brought[actor.track]

    def at(self, actor: Actor, time_us: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Directions `[K, 3]` of the light in the frame of an actor at a time, whose base is the ground there, and how much of each `[K]`
        reaches that ground."""
        step, there = _step(actor.trajectory, time_us)
        passing = self._passing.get((actor.track, step))
        if passing is None:
            passing = self._passing[actor.track, step] = self._pass(there, actor.asset.size)
        pose = actor.trajectory.at(time_us)
        heading = float(yaw_of(pose))
        about = (yaw(-heading)[:3, :3] @ pose[:3, 2]).tolist()
        steep = [math.tan(TILT * round(math.atan2(v, about[2]) / TILT)) for v in about[:2]]
        tilted = _on_slope(TURN * round(heading / TURN), *steep)
        up = tilted[:, 2]
        # as many directions as light falls on level ground from there: on a slope of each that much more or less
        level = self.light.directions[:, 2].clamp_min(GRAZING)
        share = ((self.light.directions @ up).clamp_min(0) / level).float()
        return (self.light.directions @ tilted).float(), passing * share

    def field(self, actor: Actor, box: Box, directions: torch.Tensor, weights: torch.Tensor) -> Field:
        """What an actor keeps off in a box of its frame."""
        key = (actor.track, directions.numpy().tobytes(), weights.numpy().tobytes())
        if key not in self._fields:
            self._fields[key] = trace_field(actor.asset.gaussians.detach().to("cpu"), box, directions, weights)
        return self._fields[key]

    def _pass(self, pose: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
        """The part `[K]` of the light from each direction that houses and trees let pass to just above an asset."""
        background = self.background
        if self._houses is None:
            self._houses = Blockers(squares(background.gaussians.detach().to("cpu")))
        length, width, height = size.tolist()
        spots = [[0, 0], [length / 2, width / 2], [-length / 2, width / 2], [length / 2, -width / 2], [-length / 2, -width / 2]]
        points = torch.tensor([[x, y, height + 0.3] for x, y in spots], dtype=torch.float64)
        local_from_asset = inverse(background.world_from_local) @ pose
        points = points @ local_from_asset[:3, :3].T + local_from_asset[:3, 3]
        turned = self.light.directions @ inverse(background.world_from_local)[:3, :3].T
        each = torch.eye(len(turned), dtype=torch.float32)
        passing = torch.stack([self._houses.open_share(points, turned, one, AROUND).mean() for one in each])
        return passing if bool((passing > 0).any()) else torch.ones(len(turned), dtype=torch.float32)  # under a bridge any light will do


def _on_slope(heading: float, forward: float, left: float) -> torch.Tensor:
    """The rotation `[3, 3]` of what stands at a heading on a plane whose normal leans so much forward and left, a metre up."""
    up = torch.nn.functional.normalize(torch.tensor([forward, left, 1.0], dtype=torch.float64), dim=0)
    ahead = torch.nn.functional.normalize(torch.tensor([1.0, 0.0, -forward], dtype=torch.float64), dim=0)
    return yaw(heading)[:3, :3] @ torch.stack([ahead, torch.linalg.cross(up, ahead), up], 1)


def _step(path: Trajectory, time_us: int) -> tuple[int, torch.Tensor]:
    """Of the places every `STEP` metres along a path the one nearest to where it is at a time: its number, and the pose `[4, 4]` there.

    It is the same whichever moment is asked for first, so that a frame does not depend on those before it.
    """
    times = (path.times_us - path.times_us[0]).numpy()
    gone = np.cumsum([0.0, *path.world_from_body[:, :3, 3].diff(dim=0).norm(dim=1).tolist()])
    step = round(np.interp(time_us - int(path.times_us[0]), times, gone) / STEP)
    return step, path.near(int(path.times_us[0]) + round(np.interp(step * STEP, gone, times)))


_shades: dict[int, Shade] = {}


def _shade(scene: Scene) -> Shade:
    """The shade of a scene: kept for as long as that lives, since a clip asks frame by frame. It does not hold the scene."""
    shade = _shades.get(id(scene))
    if shade is None:
        shade = _shades[id(scene)] = Shade(scene)
        weakref.finalize(scene, _shades.pop, id(scene), None)
    return shade


def _asset_from_cam(actor: Actor, camera: Camera) -> torch.Tensor:
    """float64 `[N, 4, 4]`: one, or where either moves while the image is read out, one for each row or column."""
    start, end = actor.trajectory.at(camera.time_us), end_pose(actor, camera.time_us, camera.readout_us)
    cam_start, cam_end = camera.world_from_cam.detach(), camera.world_from_cam_end
    if camera.shutter == "global" or (end is None and cam_end is None):
        return (inverse(start) @ cam_start)[None]
    return inverse(readout(camera, start, end)) @ readout(camera, cam_start, None if cam_end is None else cam_end.detach())


def _window(asset_from_cam: torch.Tensor, box: Box, camera: Camera) -> tuple[int, int, int, int] | None:
    """Pixels that a box projects into, from poses `[N, 4, 4]`; None where that is outside the image, or the ground is seen from below.

    A lens that sees beyond 90 degrees may see it anywhere, and one that does not, where a part of the box is beyond what it sees.
    """
    lens, count = camera.lens, min(len(asset_from_cam), MOMENTS)
    poses = asset_from_cam[torch.linspace(0, len(asset_from_cam) - 1, count, dtype=torch.float64).long()]
    if not isinstance(lens, Orthographic) and not (poses[:, 2, 3] > 0).any():
        return None
    cam_from_asset, wide = inverse(poses), lens.limit() > math.pi / 2
    seen = box.edges(ALONG) @ cam_from_asset[:, :3, :3].mT + cam_from_asset[:, None, :3, 3]
    if not ((lens.depth(seen) if wide else seen[..., 2]) > 0).any():
        return None
    if wide or not (lens.valid(seen) & (seen[..., 2] > 0.1)).all():  # there the projected edges bound nothing
        low, high = torch.zeros(2, dtype=torch.float64), torch.tensor([camera.width, camera.height])
    else:
        pixels = lens.project(seen).detach().reshape(-1, 2)
        low, high = pixels.amin(0).floor(), pixels.amax(0).ceil()
    x0, y0 = (int(v) for v in low.clamp_min(0))
    x1, y1 = min(int(high[0]), camera.width), min(int(high[1]), camera.height)
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None
