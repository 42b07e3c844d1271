"""How the road looks from beside the path: a photo taken at the same moment knows it, and where each point of it lies."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree

from recon.ground import above_ground
from recon.log import Track
from recon.objects.actors import box_skin
from recon.views.frames import Frames
from recon.views.project import nearest_around, project
from recon.views.view import View
from render.flat_field import evened
from scenes.camera import Camera
from scenes.ground import Ground
from scenes.poses import inverse

ON_ROAD = 0.1
"""Metres from the ground up to which a lidar point is the road's."""

TOGETHER = 16
"""Points whose mean height one is given. Lidar's noise of 3 cm would move what lies 20 m ahead by a pixel, seen from 2 m aside."""

SKIN = 0.25
"""Metres between the points of a box's sides."""

BESIDE = 1.5
"""Degrees around what stands within which it hides the road behind: as far apart as beams lie, and more."""


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


def standing(points: np.ndarray, ground: Ground, tracks: Sequence[Track], time_us: int) -> np.ndarray:
    """What may hide the road at a moment, `[M, 3]`: those of lidar's points `[N, 3]` that are off it, and the sides of all boxes, of whose
    glass and dark paint no beam comes back."""
    off = above_ground(points, ground)
    skins = [points[np.abs(off) >= ON_ROAD]]
    for track in tracks:
        pose = track.trajectory().near(time_us).numpy()
        skins.append(box_skin(track.size, SKIN) @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(skins)


def shown_road(road: np.ndarray, others: np.ndarray, camera: Camera) -> np.ndarray:
    """Which points `[N, 3]` of the road a camera sees past what stands, `[M, 3]`; bool `[N]`."""
    row, column, z, seen = project(road, inverse(camera.world_from_cam).numpy(), camera)
    focal = max(float(f) for f in camera.lens.focal())
    return seen & (z < nearest_around(others, camera, math.ceil(focal * math.radians(BESIDE)))[row, column])


def photo_at(frames: Frames, name: str, time_us: int) -> View:
    """The view of camera `name` that was taken nearest to a time."""
    mine = [v for v in frames.views if v.camera == frames.names.index(name)]
    return min(mine, key=lambda v: abs(v.time_us - time_us))


def road_errors(shown: torch.Tensor, camera: Camera, view: View, recorded: Camera, points: np.ndarray) -> np.ndarray:
    """Squared errors `[M]`, means of three channels, of a picture `[H, W, 3]` of `camera`'s at points `[N, 3]` of the road, against what
    the photo of `view`, taken by `recorded`, has there, wherever in their pictures it lies; of those that lie within both, and in the photo
    not on the recording car."""
    colours, within = _looked_up(evened(view.image.float() / 255, camera.flat_field), recorded, points)
    if view.ego is not None:
        on_car, _ = _looked_up(view.ego.float()[..., None], recorded, points)
        within &= on_car[:, 0] == 0
    seen, there = _looked_up(evened(shown.clamp(0, 1), camera.flat_field), camera, points)
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
