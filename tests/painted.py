"""A made-up drive of two cameras without lidar towards a wall: ground and wall painted with blotches, so that every depth is known; and
sweeps that a lidar would add to it."""

from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from recon.log import LidarPoints, Log, LogCamera, Packed, Sweep
from render.rays import world_directions
from scenes.camera import Camera
from scenes.lenses import Pinhole
from scenes.poses import CAM_FROM_FLU, inverse, translation, yaw
from scenes.trajectory import Trajectory

SIZE = (320, 180)
HEIGHT, WALL = 1.5, 20.0
"""Metres from the cameras down to the ground, and from the first one ahead to a wall."""

CAMERAS = {"front": 0.0, "left": 0.5}
"""Radians that they are turned to the left."""

BOARD, AHEAD, STRIDE = 1.6, 9.0, 0.5
"""Side of a painted board that crosses the street, how far ahead of the first camera, and its metres a picture."""

LONG = 4.3
"""Metres that the flanks of what goes along the street are long."""


Rear = Callable[[float], tuple[float, float]]
"""At seconds, how far ahead of the first camera and to its left the right edge of a car's painted end is."""


def board_left(index: int) -> float:
    """Where the board's right edge is when picture `index` is taken, in metres to the left of the first camera."""
    return -3.0 + STRIDE * index


def depth_of(camera: Camera) -> torch.Tensor:
    """Distance along z = 1 rays, float64 `[H, W]`, to the ground and the wall."""
    rays = world_directions(camera).double()
    eye = camera.world_from_cam[:3, 3]
    ground = torch.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], torch.inf)
    wall = torch.where(rays[..., 0] > 0, (WALL - eye[0]) / rays[..., 0], torch.inf)
    return torch.minimum(ground, wall)


def _picture(camera: Camera, blotches: torch.Tensor, boards: list[tuple[float, float, float, float]]) -> Packed:
    """Both painted with blotches of a third of a metre, and boards, brighter, so far ahead, with their right lower corners so far left and
    up, and flanks so long behind them."""
    rays, depth = world_directions(camera).double(), depth_of(camera)
    eye = camera.world_from_cam[:3, 3]
    at = eye + rays * depth[..., None]
    plane = torch.where((at[..., 2] < 1e-6)[..., None], at[..., :2], at[..., 1:] + 50)
    image = _painted(blotches, plane)
    for ahead, left, up, long in boards:
        at = eye + rays * ((ahead - eye[0]) / rays[..., 0])[..., None]
        plane = at[..., 1:] - torch.tensor([left, up])
        hit = ((plane > 0) & (plane < BOARD)).all(-1) & (rays[..., 0] > 0) & (eye[0] < ahead)
        image = torch.where(hit[..., None], 0.5 + 0.5 * _painted(blotches, plane + 20), image)
        # the flank that looks at us, if one does
        side = left if eye[1] < left else left + BOARD
        depth = (side - eye[1]) / rays[..., 1]
        at = eye + rays * depth[..., None]
        plane = at[..., ::2] - torch.tensor([ahead, up])
        hit = (
            (depth > 0)
            & (plane > 0).all(-1)
            & (plane < torch.tensor([long, BOARD])).all(-1)
            & ((eye[1] - left) * (eye[1] - left - BOARD) > 0)
        )
        image = torch.where(hit[..., None], 0.5 + 0.5 * _painted(blotches, plane - 20), image)
    buffer = BytesIO()
    Image.fromarray((image * 255).byte().numpy()).save(buffer, "png")
    return Packed("painted", buffer.getvalue)


def _painted(blotches: torch.Tensor, plane: torch.Tensor) -> torch.Tensor:
    found = torch.nn.functional.grid_sample(blotches, (plane[None] / 100).float(), padding_mode="reflection", align_corners=False)
    return found[0].permute(1, 2, 0)


def drive(
    steps: list[float], names: tuple[str, ...] = tuple(CAMERAS), board: bool = False, rears: Sequence[Rear] = (), step_us: int = 100_000
) -> Log:
    """The drive whose pictures are taken after so many metres each, `step_us` apart. rears: cars' ends on the ground, with flanks."""
    blotches = torch.rand(1, 3, 600, 600, generator=torch.Generator().manual_seed(0))
    lens, times = Pinhole(160, 160, 160, 90), torch.arange(len(steps)) * step_us
    bodies = torch.stack([translation(x, x / 12, HEIGHT) for x in np.cumsum(steps)])
    cameras = {}
    for name in names:
        poses = bodies @ yaw(CAMERAS[name]) @ inverse(CAM_FROM_FLU)
        views = [Camera(lens, *SIZE, pose) for pose in poses]
        crossing = [[(AHEAD, board_left(i), 0.3, 0.0)] if board else [] for i in range(len(views))]
        going = [[(*rear(float(t) / 1e6), 0.0, LONG) for rear in rears] for t in times]
        pictures = tuple(_picture(v, blotches, a + b) for v, a, b in zip(views, crossing, going, strict=True))
        cameras[name] = LogCamera(name, lens, *SIZE, pictures, times, poses)
    return Log("bare", Path("bare"), cameras, (), (), Trajectory(times, bodies), {}, names)


def sweep_of(time_us: int, *parts: np.ndarray) -> Sweep:
    """A sweep at a time of points `[N, 3]`."""
    xyz = np.concatenate(parts)
    return Sweep(0, time_us, lambda: LidarPoints(xyz, np.full(len(xyz), time_us), np.zeros(len(xyz), np.int64)))


def wall(x: float, low: float, high: float, step: float = 0.05) -> np.ndarray:
    """Points on an upright wall x metres ahead, from y low to high, 0.5 to 2.5 m above the ground."""
    y, z = np.meshgrid(np.arange(low, high, step), np.arange(0.5, 2.5, step))
    return np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()])
