"""How each view was exposed: photos are brought to one exposure, and frames of a camera that follows the light say theirs."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage

from recon.log import Log, SparsePoints
from recon.views.gains import gains_along, picture_gains
from recon.views.project import project
from recon.views.view import View
from scenes.camera import Camera
from scenes.poses import inverse
from scenes.trajectory import between

VARIES, LOOKED = 0.12, 4
"""Spread of the logarithms of a camera's gains from which on each frame has its own, and every which frame shows whether they vary. Those
of drive 002's right cameras spread by 0.07: that gains nothing there, and a haze makes up for the tints in which other cameras see it."""

PROBED = 3000
"""Points of a sweep by which exposures are compared, of those within reach."""

REACH = 40.0
"""Metres up to which these are taken: little comes between them and a camera a second later."""


def balanced(log: Log, names: list[str], views: list[View]) -> list[View]:
    """The views with their pictures divided by what each was exposed more than the others, by the points that they share."""
    assert log.points is not None
    colours, shown = [], []
    for view in views:
        camera = log.camera(names[view.camera]).camera(view.index, view.image.shape[1], view.image.shape[0])
        points = log.points.seen[names[view.camera]][view.index]
        row, column, _, inside = project(log.points.xyz[points], inverse(camera.world_from_cam).numpy(), camera)
        # a point's own pixel is at an edge as likely as not: what is around it is steadier
        smooth = ndimage.uniform_filter(view.image.numpy().astype(np.float32), (5, 5, 0)) / 255
        colours.append(smooth[row[inside], column[inside]])
        shown.append(points[inside])
    gains = picture_gains(colours, shown, len(log.points.xyz))
    return [_divided(v, torch.from_numpy(g).float()) for v, g in zip(views, gains, strict=True)]


def _divided(view: View, gain: torch.Tensor) -> View:
    """A view with a gain `[3]` taken out of its picture."""
    return replace(view, image=(view.image.float() / gain).round().clamp(0, 255).to(torch.uint8))


def exposed(log: Log, names: list[str], views: list[View]) -> list[View]:
    """The views with their gains, where a camera's vary by what lidar points look like in them, which it says; those of held-out views are
    what their neighbours' make likely."""
    sweeps = log.sweeps_within((min(v.time_us for v in views), max(v.time_us for v in views)))
    if not sweeps:
        return views
    known: dict[int, np.ndarray] = {}

    def points(view: View, camera: Camera) -> np.ndarray:
        nearest = min(sweeps, key=lambda s: abs(s.time_us - view.time_us))
        if nearest.index not in known:
            xyz = nearest.read().xyz
            near = xyz[np.linalg.norm(xyz - camera.world_from_cam[:3, 3].numpy(), axis=1) < REACH]
            known[nearest.index] = near[:: max(1, len(near) // PROBED)]
        return known[nearest.index]

    return _gained(log, names, views, points)


def exposed_by(sparse: SparsePoints, log: Log, names: list[str], views: list[View]) -> list[View]:
    """As `exposed`, of a drive without lidar, by the points that its pictures showed."""
    return _gained(log, names, views, lambda view, _: sparse.xyz[sparse.seen[names[view.camera]][view.index]])


def _gained(log: Log, names: list[str], views: list[View], points: Callable[[View, Camera], np.ndarray]) -> list[View]:
    """The views with their gains, by world points `[N, 3]` that each view and camera shows."""

    def gains(mine: list[View], name: str) -> np.ndarray:
        cameras = [log.camera(name).camera(v.index) for v in mine]
        return gains_along([v.image for v in mine], cameras, [points(v, c) for v, c in zip(mine, cameras, strict=True)])

    out = []
    for c, name in enumerate(names):
        mine = [v for v in views if v.camera == c]
        shown = [v for v in mine if not v.held_out]
        few = np.log(gains(shown[:: min(LOOKED, 1 + len(shown) // 16)], name))  # NaN where frames so far apart show nothing together
        varies = np.isnan(few).any() or few.std(0).max() >= VARIES
        logs = torch.from_numpy(np.log(gains(shown, name))).float() if varies else torch.zeros(0, 3)
        told = logs.isfinite().all(1)
        if told.sum() < 2 or logs[told].std(0).max() < VARIES:
            out += mine
            continue
        shown, logs = [v for v, t in zip(shown, told.tolist(), strict=True) if t], logs[told]
        least, most = logs.mean(1).exp().aminmax()
        print(f"{name}: its exposure varies, {float(most / least):.1f}-fold; each frame is given its own", file=sys.stderr)
        times = torch.tensor([v.time_us for v in shown])
        out += [replace(v, gain=between(times, logs, v.time_us).exp()) for v in mine]
    return out
