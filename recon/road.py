"""How the road looks from beside the path: a photo taken at the same moment knows it, and where each point of it lies."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree

from recon.frames import Frames
from recon.view import View
from scenes.camera import Camera
from scenes.ground import Ground
from scenes.poses import inverse

ON_ROAD = 0.1
"""Metres from the ground up to which a lidar point is the road's."""

TOGETHER = 16
"""Points whose mean height one is given. Lidar's noise of 3 cm would move what lies 20 m ahead by a pixel, seen from 2 m aside."""


def road_points(points: np.ndarray, ground: Ground) -> np.ndarray:
    """Those of a sweep's points `[N, 3]` that lie on the road, `[M, 3]`, at the height that their neighbours have over `ground`."""
    height = ground.height(torch.from_numpy(points[:, :2])).numpy()
    off = points[:, 2] - height
    lying = np.abs(off) < ON_ROAD
    if lying.sum() < TOGETHER:
        return np.zeros((0, 3))
    points, height, off = points[lying], height[lying], off[lying]
    _, beside = cKDTree(points[:, :2]).query(points[:, :2], TOGETHER)
    return np.column_stack([points[:, :2], height + off[beside].mean(1)])


def photo_at(frames: Frames, name: str, time_us: int) -> View:
    """The view of camera `name` that was taken nearest to a time."""
    mine = [v for v in frames.views if v.camera == frames.names.index(name)]
    return min(mine, key=lambda v: abs(v.time_us - time_us))


def road_errors(shown: torch.Tensor, camera: Camera, view: View, recorded: Camera, points: np.ndarray) -> np.ndarray:
    """Squared errors `[M]`, means of three channels, of a picture `[H, W, 3]` of `camera`'s at points `[N, 3]` of the road, against what
    the photo of `view`, taken by `recorded`, has there; of those that lie within both, and in the photo not on the recording car."""
    colours, within = _looked_up(view.image.float() / 255, recorded, points)
    if view.ego is not None:
        on_car, _ = _looked_up(view.ego.float()[..., None], recorded, points)
        within &= on_car[:, 0] == 0
    seen, there = _looked_up(shown.clamp(0, 1), camera, points)
    return (seen - colours).double().square().mean(1)[within & there].numpy()


def _looked_up(image: torch.Tensor, camera: Camera, points: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """What an image `[H, W, C]` of a camera's shows at world points `[N, 3]`, between its pixels, and whether they lie within it."""
    cam_from_world = inverse(camera.world_from_cam)
    local = torch.from_numpy(points) @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    size = torch.tensor([camera.width, camera.height])
    pixels = torch.full((len(points), 2), -1.0, dtype=torch.float64)
    before = (local[:, 2] > 0) & camera.lens.valid(local)
    pixels[before] = camera.lens.project(local[before]).double()
    at = (2 * pixels / size - 1).to(image)
    found = F.grid_sample(image.permute(2, 0, 1)[None], at[None, None], padding_mode="border", align_corners=False)[0, :, 0].T
    return found, ((pixels >= 0.5) & (pixels <= size - 0.5)).all(1)
