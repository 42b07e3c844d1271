"""What stands on the ground: the pose of an asset at a place, and the paths of recorded actors that are replaced or moved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch.nn import functional as F

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
    headings = torch.tensor(heading, dtype=torch.float64)
    height, rise, bank = plane_under(partial(ground_heights, scene), xy, headings, size)
    return leaning_pose(torch.cat([xy, height[None]]), headings, rise, bank)


def plane_under(
    heights: Callable[[torch.Tensor], torch.Tensor], xy: torch.Tensor, headings: torch.Tensor, size: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The planes that fit `heights` of points `[..., P, 2]` under the footprint of a body of a size `[3]` at world points `[..., 2]`,
    headings `[...]` in radians: heights there, and metres that they rise with every metre forward and left, `[...]` each."""
    forward, left = _ways(headings)
    spread = torch.linspace(-0.4, 0.4, 5, dtype=torch.float64)
    u, v = torch.meshgrid(spread, spread, indexing="ij")
    along, across = (u * size[0]).reshape(-1), (v * size[1]).reshape(-1)
    under = heights(xy[..., None, :] + along[:, None] * forward[..., None, :] + across[:, None] * left[..., None, :])
    # the grid is symmetric about its centre, so the least-squares plane separates into a mean and two slopes
    return under.mean(-1), (along * under).sum(-1) / (along * along).sum(), (across * under).sum(-1) / (across * across).sum()


def leaning_pose(places: torch.Tensor, headings: torch.Tensor, rise: torch.Tensor, bank: torch.Tensor) -> torch.Tensor:
    """Poses `[..., 4, 4]` at places `[..., 3]`, headings in radians, on planes that rise so many metres with every metre forward and left,
    `[...]` each."""
    forward, left = _ways(headings)
    x_axis = F.normalize(torch.cat([forward, rise[..., None]], -1), dim=-1)
    z_axis = F.normalize(torch.linalg.cross(x_axis, torch.cat([left, bank[..., None]], -1)), dim=-1)
    pose = torch.eye(4, dtype=torch.float64).repeat(*headings.shape, 1, 1)
    pose[..., :3, :3] = torch.stack([x_axis, torch.linalg.cross(z_axis, x_axis), z_axis], -1)
    pose[..., :3, 3] = places
    return pose


def _ways(headings: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Forward and left in plan, `[..., 2]`."""
    forward = torch.stack([headings.cos(), headings.sin()], -1)
    return forward, torch.stack([-forward[..., 1], forward[..., 0]], -1)


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
