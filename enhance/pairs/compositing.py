"""Assets in photos: put in anywhere with and without their shadow, or back to where they were cut out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn import functional as F

from enhance.pairs.clips import SMALLEST, Clip
from enhance.pairs.isp import Isp, alter
from render import rasterize, render_frame
from render.frame import expose
from render.frame_types import Frame
from render.references import READS, References, Shot
from render.shadow import cast, shadow_casters
from scenes.asset import Actor, Asset
from scenes.camera import Camera
from scenes.collide import collisions
from scenes.gaussians import Placed
from scenes.match import matched
from scenes.poses import yaw_of
from scenes.scene import Scene
from scenes.sky import linear_from_srgb, srgb_from_linear
from scenes.standing import outside_ground, standing_pose
from scenes.trajectory import Trajectory

TRIES = 40
NEAR, FAR = 6.0, 28.0
"""Metres from the camera at which assets are put."""

CLEAR = 3.0
"""Metres that the recorded car keeps from them."""

DARKENED = 0.02
"""Share of the light that a pixel must lose to count as shaded."""

HEM = 4
"""Pixels around an asset that count as changed where it is put back: its edge never lies quite where it was."""


class NoPlace(Exception):
    """There is no free place in view."""


def put_in(
    clip: Clip, scene: Scene, assets: Sequence[Asset], rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, Scene, dict]:
    """The photos `[T, H, W, 3]` with one of the assets in them, without and with its shadow; the shaded region `[T, H, W]`; the scene with
    the asset, and its place in words. `scene` says by its sky what casts the shadow. Raises NoPlace."""
    for _ in range(TRIES):
        asset = assets[int(rng.integers(len(assets)))]
        actor = _somewhere(clip, scene, asset, rng)
        if actor is None:
            continue
        there = replace(scene, actors=(*scene.actors, actor))
        mine = len(there.actors)
        if _share(there.to(clip.device), clip.cameras[len(clip.cameras) // 2], mine) < SMALLEST:
            continue
        bare, shaded, region = [], [], []
        for t, frame in enumerate(clip.render(there, "depth", "instance", "instance_alpha")):
            picture = over_photo(clip.photo(t), frame, actor, scene)
            light = light_left(frame, there)
            bare.append(picture)
            shaded.append(torch.where(light[..., None] < 1, srgb_from_linear(linear_from_srgb(picture) * light[..., None]), picture))
            region.append(((1 - light) / DARKENED).clamp(0, 1))
        what = {"asset": asset.label, "instances": [mine], "track": str(asset.meta.get("track", ""))}
        return torch.stack(bare), torch.stack(shaded), torch.stack(region), there, what
    raise NoPlace


def _somewhere(clip: Clip, scene: Scene, asset: Asset, rng: np.random.Generator) -> Actor | None:
    """The asset standing at a random place that the clip's middle camera sees; None where it would stand in something."""
    camera = clip.cameras[len(clip.cameras) // 2]
    pose = camera.world_from_cam
    ahead = F.normalize(pose[:2, 2], dim=0)
    distance = rng.uniform(NEAR, FAR)
    aside = rng.uniform(-0.8, 0.8) * distance * camera.width / (2 * camera.lens.focal()[0])
    xy = pose[:2, 3] + distance * ahead + aside * torch.stack([ahead[1], -ahead[0]])
    path = torch.stack([c.world_from_cam[:2, 3] for c in clip.cameras])
    if float((path - xy).norm(dim=1).min()) < CLEAR + float(asset.size[:2].norm()) / 2 or outside_ground(scene, xy) > 0:
        return None
    heading = float(yaw_of(scene.ego.at(camera.time_us))) + float(rng.choice([0.0, math.pi])) + rng.normal(0, 0.15)
    stands = Trajectory(torch.tensor([camera.time_us]), standing_pose(scene, xy, heading, asset.size)[None])
    lit = matched(asset, scene, xy)
    actor = Actor(replace(lit, meta={**lit.meta, "inserted": True}), stands, "put_in")
    while_seen = Trajectory(torch.tensor([c.time_us for c in clip.cameras]), torch.stack([c.world_from_cam for c in clip.cameras]))
    return None if collisions(replace(scene, ego=while_seen), actor) else actor


def _share(scene: Scene, camera: Camera, instance: int) -> float:
    """The part of a view that an instance covers."""
    with torch.no_grad():
        frame = render_frame(scene, camera, ("instance",))
    assert frame.instance is not None
    return float((frame.instance == instance).float().mean())


def over_photo(photo: torch.Tensor, frame: Frame, actor: Actor, scene: Scene) -> torch.Tensor:
    """A photo `[H, W, 3]` with an actor over it where `frame`, with instance_alpha, says that it is seen: the last one placed."""
    assert frame.instance_alpha is not None
    rgb, alpha = _alone(actor, frame.camera, scene)
    covers = frame.instance_alpha[..., -1:]
    return torch.where(covers > 1 / 512, photo + covers * (rgb / alpha.clamp_min(1 / 512) - photo), photo).clamp(0, 1)


def _alone(actor: Actor, camera: Camera, scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
    """An actor without anything around it, exposed as the camera exposes: premultiplied rgb `[H, W, 3]` and alpha `[H, W, 1]`."""
    with torch.no_grad():
        placed = Placed(actor.asset.gaussians, actor.trajectory.at(camera.time_us))
        frame = rasterize(placed, camera, ("rgb", "alpha"), model=scene.model_for(camera))
    assert frame.rgb is not None and frame.alpha is not None
    alpha = frame.alpha[..., None]
    return expose(frame.rgb / alpha.clamp_min(1 / 512), camera) * alpha, alpha


def light_left(frame: Frame, scene: Scene) -> torch.Tensor:
    """The part of the light `[H, W]`, 0 to 1, that the scene's inserted and edited actors leave: of a frame with depth and instance, and
    by its instance_alpha, if it has that, exact at their rims."""
    assert frame.depth is not None
    white = torch.ones(*frame.depth.shape, 3)
    casters = shadow_casters(scene, frame.camera)
    if not casters:
        return white[..., 0]
    each, shares = frame.instance_alpha, None
    if each is not None:
        shares = each[..., [caster.instance for caster in casters]] / each.sum(-1, keepdim=True).clamp_min(1e-6)
    return linear_from_srgb(cast(replace(frame, rgb=white), casters, shares)[..., 0]).clamp(0, 1)


@dataclass(frozen=True)
class PutBack:
    """Frames with assets put back: `[T, H, W, 3]` in 0..1 as they look, what photos say of them, and `[T, H, W]` in 0..1 how far that is to
    be trusted, and where they differ from the photos that they should be."""

    frames: torch.Tensor
    reference: torch.Tensor
    trust: torch.Tensor
    region: torch.Tensor


def put_back(clip: Clip, scene: Scene, instances: Sequence[int], isp: Isp, shots: Sequence[Shot] = ()) -> PutBack:
    """The photos with a rendering of `scene` where `instances` and their shadows are, without the shadows, and the instances in other
    colours; with what `shots`, and the photos of the instances' assets, say of it, but never those that the clip's frames are."""
    found, wanted = [], torch.tensor(instances, dtype=torch.int32)
    here = scene.to(clip.device)
    references = References(shots, clip.scene.to(clip.device), here)
    for t, drawn in enumerate(references.along(clip.draw(here, *READS, shadows=False), clip.cameras)):
        frame = drawn.to("cpu")
        assert frame.rgb is not None and frame.instance is not None and frame.reference is not None and frame.trust is not None
        mine = torch.isin(frame.instance, wanted).float()
        was = torch.isin(clip.geometry()["instance"][t].int(), wanted).float()
        around = _grown(torch.maximum(mine, was), HEM)
        shade = ((1 - light_left(frame, scene)) / (4 * DARKENED)).clamp(0, 1)
        region = torch.maximum(around, shade)
        pictures = [_over(clip.photo(t), rgb, region, _soft(mine), isp) for rgb in (frame.rgb.clamp(0, 1), frame.reference)]
        found.append((*pictures, frame.trust * (region > 1 / 512), region))  # a byte's least
    return PutBack(*(torch.stack(part) for part in zip(*found, strict=True)))


def _over(photo: torch.Tensor, rgb: torch.Tensor, region: torch.Tensor, mask: torch.Tensor, isp: Isp) -> torch.Tensor:
    """A picture `[H, W, 3]`, in other colours where `mask` says, in the place of the `region` of a photo."""
    altered = alter(rgb.permute(2, 0, 1), mask[None], isp).permute(1, 2, 0)
    return torch.where(region[..., None] > 0, photo + region[..., None] * (altered - photo), photo)


def _soft(mask: torch.Tensor) -> torch.Tensor:
    return F.avg_pool2d(mask[None, None], 3, 1, 1)[0, 0]


def _grown(mask: torch.Tensor, by: int) -> torch.Tensor:
    """A mask `[H, W]` grown by some pixels, its edge soft."""
    return _soft(F.max_pool2d(mask[None, None], 2 * by + 1, 1, by)[0, 0])
