"""Reads KITTI's odometry sequences (Geiger et al. 2012; the layout as in the devkit's readme.txt).

`sequences/<n>` with image_0 to image_3, velodyne, calib.txt, times.txt and the poses in `../../poses/<n>.txt`. The body is the lidar, whose
points are published untwisted; the first camera, turned, where a calibration without lidar's `Tr` came with pictures alone.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import torch

from recon.log import LidarPoints, Log, Sweep, lengthened
from recon.readers.kitti_files import (
    SHARE,
    calibration,
    in_pose,
    kitti_log,
    log_camera,
    named,
    picture_files,
    projection,
    read_scan,
    rotation_us,
    rows_of,
    scan_times,
)
from recon.readers.stated import rigid
from scenes.poses import CAM_FROM_FLU, inverse


def is_kitti_odometry(path: Path) -> bool:
    return (path / "calib.txt").is_file() and (path / "times.txt").is_file()


def read_kitti_odometry(path: Path) -> Log:
    """The odometry sequence in folder `path`. FileNotFoundError and ValueError name the file that is missing or wrong."""
    number = path.resolve().name
    times = np.round(np.array(rows_of(path / "times.txt", 1))[:, 0] * 1e6).astype(np.int64)
    if not (np.diff(times) > 0).all():
        raise ValueError(f"{path / 'times.txt'} must have seconds that rise strictly; fetch it again")
    where = next((p for p in (path / "poses.txt", path.resolve().parents[1] / "poses" / f"{number}.txt") if p.is_file()), None)
    if where is None:
        missing = path.resolve().parents[1] / "poses" / f"{number}.txt"
        raise FileNotFoundError(f"{missing} is missing; KITTI publishes poses of the sequences 00 to 10, for others write your own there")
    rows = np.array(rows_of(where, 12)).reshape(-1, 3, 4)
    if len(rows) != len(times):
        raise ValueError(f"{where} has {len(rows)} poses for the {len(times)} times of {path / 'times.txt'}; they must be as many")
    camera_world = torch.eye(4, dtype=torch.float64).repeat(len(rows), 1, 1)
    camera_world[:, :3] = torch.from_numpy(rows)
    camera_world = rigid(camera_world, str(where))
    calib = calibration(path / "calib.txt")
    blind = "Tr" not in calib and not (path / "velodyne").is_dir()  # the calibration that comes with grey pictures knows no lidar
    mount = CAM_FROM_FLU if blind else in_pose(named(calib, "Tr", 12, path / "calib.txt"))
    cam_from_body = rigid(mount, f"{path / 'calib.txt'}, Tr")
    # the poses' world is the first rectified camera; ours is the first body pose, turned to where up is in the mean: it may be on a slope
    poses = _levelled(inverse(camera_world[0] @ cam_from_body) @ camera_world @ cam_from_body)
    ego = lengthened(times, poses)
    cameras = {}
    for folder in sorted(path.glob("image_[0-3]")):
        lens, beside = projection(calib, f"P{folder.name[-1]}", path / "calib.txt")
        files = picture_files(folder, len(times), 6)
        world = poses @ inverse(beside @ cam_from_body)
        cameras[folder.name] = log_camera(folder.name, lens, files, times, world)
    sweeps = tuple(
        Sweep(i, int(t), partial(_sweep, file, poses[i], int(t), rotation_us(times)))
        for i, t in enumerate(times)
        if (file := path / "velodyne" / f"{i:06d}.bin").is_file()
    )
    meta = {
        "name": f"kitti-odometry-{number}", "source": f"KITTI odometry sequence {number}", **SHARE,
        "body": f"{'first camera' if blind else 'lidar'}, x forward, y left, z up",
    }  # fmt: skip
    return kitti_log(meta, path, cameras, sweeps, (), ego, torch.zeros(3, dtype=torch.float64))


def _levelled(poses: torch.Tensor) -> torch.Tensor:
    """A body's poses `[F, 4, 4]`, the first of them at 0 and not turned, in a world whose z is up for most of them; the first still heads
    along x."""
    up = poses[:, :3, 2].mean(0)
    up = up / up.norm()
    left = torch.linalg.cross(up, poses[0, :3, 0])
    left = left / left.norm()
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.stack([torch.linalg.cross(left, up), left, up])
    return turn @ poses


def _sweep(file: Path, world_from_lidar: torch.Tensor, stamp: int, rotation: int) -> LidarPoints:
    """An untwisted sweep: what drives was where it stands in it when the lidar looked there."""
    local = read_scan(file)
    xyz = local @ world_from_lidar[:3, :3].numpy().T + world_from_lidar[:3, 3].numpy()
    return LidarPoints(xyz, scan_times(local, stamp, rotation), np.zeros(len(xyz), np.int64))
