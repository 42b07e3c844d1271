"""The photos of an object, cut out of those that its scene was made from: the best of each direction that it was seen from."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch.nn import functional as F

from recon.assets.looking import corners_of, looking_at
from render import Frame, rasterize, render_frame
from render.rays import camera_rays
from render.references import Shot
from scenes.asset import Asset, AssetPhoto
from scenes.camera import Camera
from scenes.lenses import Pinhole
from scenes.poses import inverse
from scenes.scene import Scene
from scenes.trajectory import Trajectory

SECTORS = 30
"""Directions around an object, 12 degrees each: of each the best photos are kept."""

EACH, APART = 2, 1_000_000
"""Photos that are kept of a direction, and microseconds between them: reflections in a car are those of the street around it."""

MOST = 24
"""Photos of an object, the sharpest."""

FEWEST_PIXELS, MOST_PIXELS = 48, 400
"""Pixels along an object's diagonal in a photo: fewer show no more than its splats, and more are shrunk to that."""

INSIDE = 0.6
"""Part of the object's outline that lies in the picture."""

SHOWN, TRIES = 0.5, 4
"""Part of what is there of the object that nothing hides, and photos of a direction in which more is before no others are looked at."""

NEAREST = 1.0
"""Metres of the eye from the object's box at least."""

BASE = 0.05
"""Metres above the base of a box up to which what is seen is road."""


@dataclass(frozen=True)
class _View:
    """A shot that shows an object: its camera in the object's frame, the pixels that the object's diagonal has there, its direction."""

    shot: Shot
    camera: Camera
    pixels: float
    sector: int


def photos_of(asset: Asset, scene: Scene, shots: Sequence[Shot], box: Trajectory, instance: int) -> tuple[AssetPhoto, ...]:
    """The photos of an asset that was cut out of a scene, where it is shown as an `instance`, or as background (0) inside its box.

    shots: those that the scene was made from; box: where the asset's frame was on the drive.
    """
    kept: list[AssetPhoto] = []
    moments: dict[int, list[int]] = defaultdict(list)
    hidden: dict[int, int] = defaultdict(int)
    for view in sorted(_views(shots, box, asset.size), key=lambda v: -v.pixels):
        time_us, taken = view.camera.time_us, moments[view.sector]
        near = any(abs(t - time_us) < APART for t in taken)
        if len(kept) == MOST or len(taken) == EACH or near or hidden[view.sector] == TRIES:
            continue
        photo = _cut(asset, scene, view, box.at(time_us), instance)
        if photo is None:
            hidden[view.sector] += 1
        else:
            kept.append(photo)
            taken.append(time_us)
    return tuple(kept)


def _views(shots: Iterable[Shot], box: Trajectory, size: torch.Tensor) -> Iterable[_View]:
    """The shots in which most of the box lies, from beside it, and large enough."""
    corners, middle = corners_of(size), torch.tensor([0, 0, float(size[2]) / 2], dtype=torch.float64)
    for shot in shots:
        if not box.covers(shot.camera.time_us):
            continue
        pose = inverse(box.at(shot.camera.time_us)) @ shot.camera.world_from_cam
        eye = pose[:3, 3]
        beside = (eye[:2].abs() - size[:2] / 2).clamp_min(0).norm()
        local = (corners - eye) @ pose[:3, :3]
        lens = shot.camera.lens
        if float(beside) < NEAREST or not bool(lens.valid(local).all()):
            continue
        pixels = lens.project(local)
        low, high, side = pixels.amin(0), pixels.amax(0), torch.tensor([shot.camera.width, shot.camera.height])
        inside = ((torch.minimum(high, side) - low.clamp_min(0)).clamp_min(0) / (high - low)).prod()
        diagonal = max(lens.focal()) * float(size.norm()) / float((eye - middle).norm())
        if float(inside) >= INSIDE and diagonal >= FEWEST_PIXELS:
            sector = round(math.atan2(float(eye[1]), float(eye[0])) / math.tau * SECTORS) % SECTORS
            yield _View(shot, replace(shot.camera, world_from_cam=pose), min(diagonal, MOST_PIXELS), sector)


@torch.no_grad()
def _cut(asset: Asset, scene: Scene, view: _View, world_from_asset: torch.Tensor, instance: int) -> AssetPhoto | None:
    """The part of a photo that shows the asset, as a pinhole camera that looks at it has it; None where most of it is hidden."""
    camera, shot, size = view.camera, view.shot.camera, asset.size
    middle = torch.tensor([0, 0, float(size[2]) / 2], dtype=torch.float64)
    eye = camera.world_from_cam[:3, 3]
    focal = min(max(camera.lens.focal()), MOST_PIXELS * float((eye - middle).norm()) / float(size.norm()))
    cut = _framed(looking_at(middle, eye, 1, 1), size, focal)
    cut = replace(cut, time_us=shot.time_us)
    there = replace(cut, world_from_cam=world_from_asset @ cut.world_from_cam)
    frame = render_frame(scene, there, ("depth", "instance"))
    alone = rasterize(asset.gaussians, cut, ("alpha",), model=scene.model_for(there))
    assert frame.depth is not None and frame.instance is not None and isinstance(alone, Frame) and alone.alpha is not None
    rays = camera_rays(cut)
    points = (rays * frame.depth.cpu()[..., None]) @ cut.world_from_cam[:3, :3].T.float() + eye.float()
    inbox = (points[..., :2].abs() <= size[:2].float() / 2 + BASE).all(-1) & (points[..., 2] > BASE) & (points[..., 2] < size[2] + BASE)
    shows = (frame.instance.cpu() == instance) & (inbox if instance == 0 else torch.isfinite(frame.depth.cpu()))
    turn = shot.world_from_cam[:3, :3].T @ there.world_from_cam[:3, :3]
    local = rays.double() @ turn.T
    at = shot.lens.project(local) / torch.tensor([shot.width, shot.height])
    taken = shot.lens.valid(local) & ((at > 0) & (at < 1)).all(-1)
    ego = torch.zeros(1, 1) if view.shot.ego is None else torch.from_numpy(view.shot.ego).float()
    grid = torch.nan_to_num(at * 2 - 1, nan=-2.0)[None].float()
    taken &= F.grid_sample(ego[None, None], grid, mode="nearest", align_corners=False)[0, 0] == 0
    if int((shows & taken).sum()) < SHOWN * int((alone.alpha > 0.5).sum()):
        return None
    shrink = focal / max(camera.lens.focal())  # read as small as it is cut out: single pixels of a larger one would be picked
    photo = torch.from_numpy(np.array(view.shot.read(round(shot.width * shrink), round(shot.height * shrink)))).float() / 255
    rgb = F.grid_sample(photo.permute(2, 0, 1)[None], grid, mode="bicubic", padding_mode="border", align_corners=False)[0]
    alpha = (shows & taken).float()[None]
    pixels = (torch.cat([rgb.clamp(0, 1) * alpha, alpha]).permute(1, 2, 0) * 255).round().to(torch.uint8)
    return AssetPhoto(cut, partial(np.array, pixels.numpy()))


def _framed(camera: Camera, size: torch.Tensor, focal: float) -> Camera:
    """A camera that looks the same way, with a focal length in pixels, and just as large as the box `[3]` that it looks at needs."""
    local = (corners_of(size) - camera.world_from_cam[:3, 3]) @ camera.world_from_cam[:3, :3]
    pixels = focal * local[:, :2] / local[:, 2:].clamp_min(0.1)
    low, high = (pixels.amin(0) - 2).floor(), (pixels.amax(0) + 2).ceil()
    width, height = (int(v) for v in (high - low).clamp_max(2 * MOST_PIXELS))
    return replace(camera, lens=Pinhole(focal, focal, -float(low[0]), -float(low[1])), width=width, height=height)
