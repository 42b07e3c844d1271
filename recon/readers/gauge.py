"""Up, metres and origin of a world that pictures alone made: structure from motion leaves all three open (its gauge)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

GUESSED_HEIGHT = 1.5
"""How high cameras are taken to stand where nobody says: it keeps a world without metres near the size of a street."""

MOSTLY = 0.03
"""Part of the points under the cameras that may lie below the ground: reflections and false matches do."""


@dataclass(frozen=True)
class Gauge:
    """A similarity from the pictures' own world to ours: x -> scale * rotation @ (x - origin). `metric` where it is in metres."""

    rotation: np.ndarray
    origin: np.ndarray
    scale: float
    metric: bool

    def points(self, xyz: np.ndarray) -> np.ndarray:
        return self.scale * (xyz - self.origin) @ self.rotation.T

    def poses(self, world_from_cam: np.ndarray) -> torch.Tensor:
        """`[F, 4, 4]` float64 of poses `[F, 4, 4]` in the pictures' own world."""
        out = world_from_cam.copy()
        out[:, :3, :3] = self.rotation @ world_from_cam[:, :3, :3]
        out[:, :3, 3] = self.points(world_from_cam[:, :3, 3])
        return torch.from_numpy(out)


def find_gauge(
    world_from_cam: np.ndarray, points: np.ndarray, camera_height: float | None = None, metres_per_unit: float | None = None
) -> Gauge:
    """The gauge of poses `[F, 4, 4]` (OpenCV axes) and points `[N, 3]`: z up, x where the first camera looks, the first camera at 0.

    Metres come from `camera_height`, metres of the cameras above the ground that the points show, or from `metres_per_unit`;
    without either the world is not metric, and scaled so that the cameras stand `GUESSED_HEIGHT` high.
    ValueError where both are given, one is not positive, or the ground cannot be seen.
    """
    if camera_height is not None and metres_per_unit is not None:
        raise ValueError("--camera-height and --metres-per-unit both set the scale; give one of them")
    for name, value in (("--camera-height", camera_height), ("--metres-per-unit", metres_per_unit)):
        if value is not None and not 0 < value < np.inf:
            raise ValueError(f"{name} must be positive, got {value:g}")
    up = up_from_cameras(world_from_cam)
    ahead = world_from_cam[0, :3, 2] - up * (world_from_cam[0, :3, 2] @ up)
    if np.linalg.norm(ahead) < 1e-3:  # it looks straight down or up: the top of its picture is ahead
        ahead = -world_from_cam[0, :3, 1] + up * (world_from_cam[0, :3, 1] @ up)
    ahead /= np.linalg.norm(ahead)
    rotation = np.stack([ahead, np.cross(up, ahead), up])
    origin = world_from_cam[0, :3, 3]
    if metres_per_unit is not None:
        return Gauge(rotation, origin, float(metres_per_unit), True)
    height = height_above_ground((world_from_cam[:, :3, 3] - origin) @ rotation.T, (points - origin) @ rotation.T)
    if camera_height is not None:
        if height is None:
            raise ValueError("--camera-height needs the ground, but too few points lie below the cameras; give --metres-per-unit instead")
        return Gauge(rotation, origin, camera_height / height, True)
    if height is None:
        away = np.linalg.norm(points - origin, axis=1)
        height = float(np.median(away)) / 6 if len(away) else 1.0
    return Gauge(rotation, origin, GUESSED_HEIGHT / height, False)


def up_from_cameras(world_from_cam: np.ndarray) -> np.ndarray:
    """The unit vector `[3]` that is up for most cameras `[F, 4, 4]`.

    Cameras are held level and move along the ground, so up is what their x axes and their motion have least of; where these leave
    it open (a car's camera that only looks ahead gives one direction, not two) the mean of their own upward axes decides.
    """
    sideways, own = world_from_cam[:, :3, 0], -world_from_cam[:, :3, 1].mean(0)
    own /= max(np.linalg.norm(own), 1e-12)
    motion = np.diff(world_from_cam[:, :3, 3], axis=0)
    motion = motion / np.maximum(np.linalg.norm(motion, axis=1, keepdims=True), 1e-12)
    level = sideways.T @ sideways / len(sideways) + motion.T @ motion / max(len(motion), 1)
    up = np.linalg.eigh(level + 0.05 * (np.eye(3) - np.outer(own, own)))[1][:, 0]
    return up if up @ own >= 0 else -up


def height_above_ground(cameras: np.ndarray, points: np.ndarray) -> float | None:
    """How high the cameras `[F, 3]` stand over the ground that points `[N, 3]` show, both with z up; None where it is not seen.

    Each point below its nearest camera (in plan) votes for the height difference; the ground is the fullest narrow band of heights
    with almost nothing beneath it.
    """
    from scipy.spatial import cKDTree

    if not len(points):
        return None
    away, nearest = cKDTree(cameras[:, :2]).query(points[:, :2])
    drop = cameras[nearest, 2] - points[:, 2]
    # far points say little: a slope or a degree of error in up moves them by more than the ground is deep
    drop = np.sort(drop[(drop > 0) & (away < 6 * np.maximum(drop, np.median(np.abs(drop))))])
    if len(drop) < 20:
        return None
    floor = np.quantile(drop, 1 - MOSTLY)
    bands = np.geomspace(floor / 8, floor, 60)
    votes = np.array([np.searchsorted(drop, b * 1.08) - np.searchsorted(drop, b / 1.08) for b in bands])
    deep = bands[votes >= 0.6 * votes.max()].max()
    inside = drop[(drop > deep / 1.08) & (drop < deep * 1.08)]
    return float(np.median(inside))
