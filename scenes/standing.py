"""What stands on the ground: the pose of an asset at a place, and the paths of recorded actors that are replaced or moved."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from scenes.poses import interpolate, yaw_of
from scenes.scene import Scene
from scenes.trajectory import Trajectory

NEAR, FAR = 0.3, 0.6
"""Metres off a recorded box's base up to which the ground is taken to be what it stood on, and from which it is not: the box is on a
bridge, or the ground a guess. Lidar boxes are off it by centimetres, and by decimetres far away."""

EDGE = 5.0
"""Metres beyond the ground's edge over which its height there counts less and less."""


def stood(path: Trajectory, size: torch.Tensor, scene: Scene) -> Trajectory:
    """A recorded path for an asset of a size `[3]`: the same places and headings, but as high and tilted as the ground there, which a box
    is only roughly. As recorded where the ground is not known, or is not what the box stood on; between the two it goes over smoothly."""
    if scene.ground is None:
        return path
    below = _below(path, size, scene)
    return replace(path, world_from_body=interpolate(path.world_from_body, below, _share(path, below, scene)))


def moved(path: Trajectory, by: tuple[float, float], size: torch.Tensor, scene: Scene) -> Trajectory:
    """The path of a body of a size `[3]`, moved by metres forward and left along it: as high above the ground as before, and as tilted
    to it, where the ground is known and what it stood on."""
    there = path.shifted(forward=by[0], lateral=by[1])
    if scene.ground is None:
        return there
    before, after = _below(path, size, scene), _below(there, size, scene)
    poses = there.world_from_body.clone()
    poses[:, :3, :3] = after[:, :3, :3] @ before[:, :3, :3].mT @ poses[:, :3, :3]
    # the shift along a tilted body already climbs with it; the ground alone decides how high the wheels are
    poses[:, 2, 3] = path.world_from_body[:, 2, 3] + after[:, 2, 3] - before[:, 2, 3]
    return replace(there, world_from_body=interpolate(there.world_from_body, poses, _share(path, before, scene)))


def _below(path: Trajectory, size: torch.Tensor, scene: Scene) -> torch.Tensor:
    """Poses `[T, 4, 4]` of what stands on the ground where a path goes."""
    return torch.stack([standing_pose(scene, pose[:2, 3], float(yaw_of(pose)), size) for pose in path.world_from_body])


def _share(path: Trajectory, below: torch.Tensor, scene: Scene) -> torch.Tensor:
    """0 to 1 `[T]`: how far the ground, on which stands what is posed `below` `[T, 4, 4]`, is taken to be what a recorded box stood on."""
    near = (FAR - (below[:, 2, 3] - path.world_from_body[:, 2, 3]).abs()) / (FAR - NEAR)
    beyond = torch.tensor([outside_ground(scene, pose[:2, 3]) for pose in path.world_from_body], dtype=torch.float64)
    return near.clamp(0, 1) * (1 - beyond / EDGE).clamp_min(0)


def standing_pose(scene: Scene, xy: torch.Tensor, heading: float, size: torch.Tensor) -> torch.Tensor:
    """`world_from_asset` `[4, 4]` at a world point `[2]`, heading in radians, on the plane that fits the ground under its footprint."""
    forward = torch.tensor([math.cos(heading), math.sin(heading)], dtype=torch.float64)
    left = torch.stack([-forward[1], forward[0]])
    spread = torch.linspace(-0.4, 0.4, 5, dtype=torch.float64)
    u, v = torch.meshgrid(spread, spread, indexing="ij")
    along, across = (u * size[0]).reshape(-1), (v * size[1]).reshape(-1)
    heights = ground_heights(scene, xy + along[:, None] * forward + across[:, None] * left)
    # the grid is symmetric about its centre, so the least-squares plane separates into a mean and two slopes
    rise, bank = (along * heights).sum() / (along * along).sum(), (across * heights).sum() / (across * across).sum()
    x_axis = torch.cat([forward, rise[None]])
    x_axis = x_axis / x_axis.norm()
    y_axis = torch.cat([left, bank[None]])
    z_axis = torch.linalg.cross(x_axis, y_axis)
    z_axis = z_axis / z_axis.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([x_axis, torch.linalg.cross(z_axis, x_axis), z_axis], 1)
    pose[:2, 3], pose[2, 3] = xy, heights.mean()
    return pose


def ground_heights(scene: Scene, xy: torch.Tensor) -> torch.Tensor:
    """World heights `[N]` float64 of the ground at points `[N, 2]`; without a ground, the low end of the splats within 3 m."""
    if scene.ground is not None:
        return scene.ground.height(xy)
    placed = scene.background
    means = placed.gaussians.means.double() @ placed.world_from_local[:3, :3].T + placed.world_from_local[:3, 3]
    around = (means[:, :2] - xy.mean(0)).norm(dim=-1) < 3
    if not around.any():
        raise ValueError("the scene has neither a ground nor splats at that place; put the asset nearer to the recorded street")
    return means[around, 2].quantile(0.1).expand(len(xy))


def outside_ground(scene: Scene, xy: torch.Tensor) -> float:
    """Metres by which a world point `[2]` lies outside the scene's ground; 0 inside, and where there is no ground."""
    if scene.ground is None:
        return 0.0
    rows, columns = scene.ground.heights.shape
    low = torch.tensor(scene.ground.origin, dtype=torch.float64)
    high = low + scene.ground.cell * torch.tensor([columns - 1, rows - 1], dtype=torch.float64)
    return float(torch.maximum(low - xy, xy - high).clamp_min(0).norm())
