"""Splats without a drive, made a scene to look at: a body that circles them, with a camera that looks inward."""

from __future__ import annotations

import math

import numpy as np
import torch

from scenes.asset import Asset
from scenes.axes import upright
from scenes.camera import RigCamera
from scenes.gaussians import Gaussians, Placed, SplatModel
from scenes.lenses import Pinhole
from scenes.poses import pose_from, yaw
from scenes.scene import Scene
from scenes.trajectory import Trajectory

CAMERA = "orbit"
FRAMES, FRAME_US = 120, 33_333
WIDTH, HEIGHT, FOCAL = 960, 544, 960.0
ELEVATION = math.radians(15)
AWAY = 4.0
"""Distance of the camera from the middle, in halves of the diagonal of the splats' box."""

REACH = 2.0
"""Standard deviations that a splat in the middle of them takes up, on either side: a few large ones are larger than that box."""

HUGE = 60.0
"""Logarithm of a size from which on nothing is taken for larger: a camera must have a place."""

STRAY = 2.0
"""Percent of the splats, at either end of each axis, that the box leaves out."""


def around(thing: Asset | Gaussians, path: str, up: str = "z", model: SplatModel = SplatModel()) -> Scene:  # noqa: B008 - frozen
    """A scene of splats, whose axis `up` points up: a body goes once around them, to the left, in four seconds, with a camera `orbit`.

    model: what plain splats were trained with; an asset has its own. A lateral shift brings the camera nearer. ValueError where there are
    no splats, and for an axis that is none; errors of the scene name `path`.
    """
    turn = upright(up)
    gaussians, model = (thing.gaussians, thing.model) if isinstance(thing, Asset) else (thing, model)
    if not len(gaussians):
        raise ValueError(f"{path} is empty: it has no splats")
    low, high = np.percentile(gaussians.means.numpy().astype(np.float64) @ turn.T, [STRAY, 100 - STRAY], axis=0)
    thick = REACH * float(gaussians.log_scales.max(1).values.double().median().clamp_max(HUGE).exp())
    away = AWAY * max(float(np.linalg.norm(high - low)) / 2, thick, 1e-3)
    turns = 2 * math.pi * np.arange(FRAMES + 1) / FRAMES
    level, height = away * math.cos(ELEVATION), away * math.sin(ELEVATION)
    places = (low + high) / 2 + np.stack([level * np.cos(turns), level * np.sin(turns), np.full_like(turns, height)], 1)
    poses = [pose_from([1.0, 0.0, 0.0, 0.0], place) @ yaw(turn + math.pi / 2) for place, turn in zip(places, turns, strict=True)]
    sine, cosine = math.sin(ELEVATION), math.cos(ELEVATION)
    inward = torch.eye(4, dtype=torch.float64)
    inward[:3, :3] = torch.tensor([[1.0, 0.0, 0.0], [0.0, -sine, cosine], [0.0, -cosine, -sine]])  # right is ahead, depth to the left
    times = FRAME_US * torch.arange(FRAMES + 1)
    camera = RigCamera(Pinhole(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2), WIDTH, HEIGHT, inward, times_us=times[:-1], fitted=False)
    stands = torch.eye(4, dtype=torch.float64)
    stands[:3, :3] = torch.from_numpy(turn)
    still = Placed(gaussians, stands)
    return Scene(still, (), None, Trajectory(times, torch.stack(poses)), {CAMERA: camera}, model, meta={"name": path, "path": path})
