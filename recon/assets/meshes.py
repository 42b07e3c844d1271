"""A textured mesh becomes a splat asset: splats on its surface (mesh_splats.py) are fitted until they look as the traced mesh does."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from recon.assets.looking import looking_at
from recon.assets.mesh_splats import MODEL, splats_of_mesh
from render import Frame, rasterize
from render.compare import decibels
from render.tracer import SKY, Mesh, TracedMesh
from scenes.asset import Asset
from scenes.camera import Camera
from scenes.gaussians import Gaussians
from scenes.match import ASPHALT


@dataclass(frozen=True)
class MeshFit:
    """How a mesh becomes splats."""

    splats: int = 30_000
    """Samples of the surface."""
    views: int = 72
    """Traced pictures that the splats are fitted to."""
    steps: int = 700
    """Pictures compared."""
    size: tuple[int, int] = (320, 240)
    """Of the pictures, in pixels."""
    seed: int = 0
    """Of the order of the pictures."""


def views_around(size: np.ndarray, count: int, pixels: tuple[int, int], offset: float = 0.0) -> list[Camera]:
    """Cameras on a spiral, from `offset` on, around a box `[length, width, height]`, from just below its middle to above."""
    centre = torch.tensor([0.0, 0.0, float(size[2]) / 2], dtype=torch.float64)
    distance = 1.75 * 2.0 * float(np.linalg.norm(size)) / 2 * 1.04
    cameras = []
    for i in range(count):
        t = (i + 0.5 + offset) / (count + 1)
        rise = -0.08 + 1.0 * t  # sine of the elevation, so that the views are spread evenly
        azimuth = (i + offset) * 2.399963229728653  # the golden angle
        level = math.sqrt(1 - rise * rise)
        direction = torch.tensor([level * math.cos(azimuth), level * math.sin(azimuth), rise], dtype=torch.float64)
        cameras.append(looking_at(centre, centre + distance * direction, *pixels))
    return cameras


def fit_to_mesh(
    start: Gaussians, traced: TracedMesh, cameras: list[Camera], config: MeshFit, report: Callable[[int, float], None] = lambda *_: None
) -> Gaussians:
    """The splats, moved, turned, resized and recoloured until they look as the traced mesh does to these cameras."""
    targets = [traced.render(c) for c in cameras]
    fields = {name: t.clone().requires_grad_(True) for name, t in start.tensors().items()}
    spacing = float(start.log_scales[:, 0].exp().median())
    rates = {"means": 0.05 * spacing, "quats": 5e-3, "log_scales": 1e-2, "logit_opacities": 4e-2, "sh": 1e-2}
    adam = torch.optim.Adam([{"params": [fields[k]], "lr": rate} for k, rate in rates.items()], betas=(0.9, 0.99), eps=1e-12, fused=True)
    dice = torch.Generator().manual_seed(config.seed)
    order = torch.cat([torch.randperm(len(cameras), generator=dice) for _ in range(-(-config.steps // len(cameras)))])[: config.steps]
    for step, i in enumerate(order.tolist()):
        for group, rate in zip(adam.param_groups, rates.values(), strict=True):
            group["lr"] = rate * 0.05 ** (step / config.steps)
        frame, target = _drawn(Gaussians(**fields), cameras[i]), targets[i]
        assert frame.rgb is not None and frame.alpha is not None and target.rgb is not None and target.alpha is not None
        # over a colour of its own each time, so that what should be opaque cannot borrow the background's
        backdrop = torch.rand(3, generator=dice)
        ours = frame.rgb + (1 - frame.alpha)[..., None] * backdrop
        theirs = target.rgb + (1 - target.alpha)[..., None] * backdrop
        error = ours - theirs
        loss = error.square().mean() * 4 + F.l1_loss(ours, theirs)
        loss.backward()
        adam.step()
        adam.zero_grad(set_to_none=True)
        with torch.no_grad():
            fields["log_scales"].clamp_(math.log(spacing) - 4.5, math.log(spacing) + 1.5)
        report(step, float(loss.detach()))
    fitted = Gaussians(**fields).detach()
    return fitted.select(torch.sigmoid(fitted.logit_opacities) > 0.02)


def _drawn(splats: Gaussians, camera: Camera) -> Frame:
    return rasterize(splats, camera, ("rgb", "alpha"), model=MODEL)


def likeness(splats: Gaussians, traced: TracedMesh, cameras: list[Camera]) -> tuple[float, float]:
    """PSNR in dB, of all views' mean squared error, of the splats against the traced mesh over mid-grey: of whole pictures, and of pixels
    that the mesh covers."""
    whole, own = [], []
    for camera in cameras:
        with torch.no_grad():
            ours, theirs = _drawn(splats, camera), traced.render(camera)
        assert ours.rgb is not None and ours.alpha is not None and theirs.rgb is not None and theirs.alpha is not None
        error = (ours.rgb + 0.5 * (1 - ours.alpha)[..., None]).clamp(0, 1) - (theirs.rgb + 0.5 * (1 - theirs.alpha)[..., None])
        whole.append(error.square().mean())
        own.append(error[theirs.alpha > 0].square().mean())
    return decibels(float(torch.stack(whole).mean())), decibels(float(torch.stack(own).mean()))


def asset_of_mesh(
    mesh: Mesh,
    label: str,
    meta: dict,
    config: MeshFit = MeshFit(),
    report: Callable[[int, float], None] = lambda *_: None,  # noqa: B008
) -> Asset:
    """A splat asset that looks as the mesh does; `meta["psnr_unseen"]` says how well, in dB over the mesh's pixels, from 8 new views."""
    size = mesh.vertices.max(0).astype(np.float64) - mesh.vertices.min(0)
    traced = TracedMesh(mesh)
    splats = fit_to_mesh(splats_of_mesh(mesh, config.splats), traced, views_around(size, config.views, config.size), config, report)
    whole, own = likeness(splats, traced, views_around(size, 8, config.size, offset=0.37))
    facts: dict = {"psnr_unseen": round(own, 2), "psnr_unseen_whole_picture": round(whole, 2), "views": config.views}
    facts["ground_linear"] = [ASPHALT * SKY] * 3
    return Asset(splats, torch.from_numpy(np.maximum(size, 1e-3)), label, MODEL, {**meta, **facts})
