"""A car on a slight bend at 8 m/s, as lidar sees it from behind, and boxes of it."""

from pathlib import Path

import numpy as np
import torch

from recon.log import LidarPoints, Log, Sweep, Track
from recon.objects.actors import box_skin
from recon.objects.tracks import upright
from scenes.trajectory import Trajectory

SIZE = np.array([4.5, 1.8, 1.5])
SKIN = box_skin(SIZE, 0.08)
SEEN = SKIN[(SKIN[:, 0] < -2.1) | (SKIN[:, 1] < -0.8)]
"""What a follower to its right sees of a car: its rear and its right."""

ROAD = np.stack(np.meshgrid(np.arange(15, 50, 0.3), np.arange(0, 20, 0.3), [0.0]), -1).reshape(-1, 3)

STEP_US, COUNT = 100_000, 30
STAMPS = STEP_US * np.arange(COUNT)


def way(times_us: np.ndarray, brakes: float = 0.0) -> torch.Tensor:
    """Where a car is that drives on a slight bend at 8 m/s, `[T, 4, 4]`, and brakes after a second by so many m/s^2."""
    t = np.asarray(times_us) / 1e6
    gone = 8 * t - brakes / 2 * np.clip(t - 1, 0, None) ** 2
    turned = 0.3 + gone / 100
    places = 100 * np.stack([np.sin(turned) - np.sin(0.3), np.cos(0.3) - np.cos(turned), 0 * t], 1)
    return upright(places + [20, 3, 0.1], turned)


def drive(track: Track, late_us=lambda k: {0: 0.0}, brakes: float = 0.0, points: int = 120) -> Log:
    """Sweeps of the car above and of the road, in which lidars, by their numbers, pass so late after the stamp `k`: at one
    moment, or at several for ever other points."""
    random = np.random.default_rng(3)

    def sweep(k: int) -> Sweep:
        xyz, times, sensors = [ROAD], [np.full(len(ROAD), STAMPS[k])], [np.zeros(len(ROAD), np.int64)]
        for sensor, late in late_us(k).items():
            local = SEEN[random.permutation(len(SEEN))[:points]] + random.normal(0, 0.02, (points, 3))
            taken = STAMPS[k] + np.resize(np.array(late), points)
            pose = way(taken, brakes).numpy()
            xyz.append((pose[:, :3, :3] @ local[:, :, None])[..., 0] + pose[:, :3, 3])
            times.append(taken)
            sensors.append(np.full(points, sensor))
        read = LidarPoints(*map(np.concatenate, (xyz, times, sensors)))
        return Sweep(k, int(STAMPS[k]), lambda: read)

    ego = Trajectory(torch.from_numpy(STAMPS), torch.eye(4, dtype=torch.float64).expand(COUNT, 4, 4))
    return Log("street", Path("street"), {}, tuple(map(sweep, range(COUNT))), (track,), ego, {})


def boxed(times_us: np.ndarray, poses: torch.Tensor, sensor=0, label: str = "car") -> Track:
    return Track("veh_1", label, True, SIZE, times_us, poses, np.broadcast_to(sensor, times_us.shape), ("a",))


def shaken(poses: torch.Tensor, metres: float = 0.15, radians: float = 0.035) -> torch.Tensor:
    """Boxes as someone draws them, each anew."""
    random = np.random.default_rng(5)
    off = upright(random.normal(0, metres, (len(poses), 3)) * [1, 1, 0.5], random.normal(0, radians, len(poses)))
    return poses @ off
