"""The files that KITTI's raw drives and odometry sequences share: calibration, pictures and scans, and the log they become."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from recon.log import Log, LogCamera, image_size, leading
from recon.readers.stated import stating
from scenes.lenses import Pinhole
from scenes.poses import translation
from scenes.trajectory import Trajectory

SHARE = {"licence": "CC BY-NC-SA 3.0", "attribution": "KITTI by Geiger, Lenz, Stiller and Urtasun"}

SUFFIXES = (".png", ".jpg")
"""Of pictures: as published, and as others made them smaller."""

FRONT = ("image_02", "image_2", "image_00", "image_0")
"""Cameras that look ahead, the first of which that is there is a log's front camera: colour before grey."""


def kitti_log(meta: dict, path: Path, cameras: dict, sweeps: tuple, tracks: tuple, ego: Trajectory, lidar: torch.Tensor) -> Log:
    """A log whose front camera comes first. lidar: its place `[3]` in the body's frame. ValueError where there are no cameras."""
    if not cameras:
        raise ValueError(f"{path} holds no camera; KITTI's colour cameras are image_02 and image_03 (odometry: image_2 and image_3)")
    front = next((n for n in FRONT if n in cameras), next(iter(cameras)))
    cameras = dict(sorted(cameras.items(), key=lambda item: (item[0] != front, item[0])))
    return Log(meta["name"], path, cameras, sweeps, tracks, ego, meta, (front,), lidars={0: lidar.numpy()})


def log_camera(name: str, lens: Pinhole, files: tuple[Path, ...], times: np.ndarray, world: torch.Tensor) -> LogCamera:
    """A camera with the first of its frames: those that `files` has. times `[F]`, world: `world_from_cam` `[F, 4, 4]`, of all frames."""
    return LogCamera(name, lens, *image_size(files[0]), files, torch.from_numpy(times[: len(files)]), world[: len(files)])


def projection(found: dict[str, list[float]], name: str, path: Path) -> tuple[Pinhole, torch.Tensor]:
    """Lens and `cam_from_rect` `[4, 4]` of a camera's projection K [I | t]: t is its place beside the reference camera."""
    p = named(found, name, 12, path).reshape(3, 4)
    with stating(f"{path}, {name}"):
        # the devkit counts pixel centres from 0, we from 0.5
        lens = Pinhole(float(p[0, 0]), float(p[1, 1]), float(p[0, 2]) + 0.5, float(p[1, 2]) + 0.5)
        return lens, translation(*torch.linalg.solve(p[:, :3], p[:, 3]).tolist())


def calibration(path: Path) -> dict[str, list[float]]:
    """The numbers of a calibration file by name; lines that hold something else (calib_time) are left out."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing; KITTI's calibration comes as a download of its own: unpack it there")
    found = {}
    for line in path.read_text(errors="replace").splitlines():
        name, _, rest = line.partition(":")
        try:
            found[name.strip()] = [float(word) for word in rest.split()]
        except ValueError:
            continue
    return found


def named(found: dict[str, list[float]], name: str, count: int, path: Path) -> torch.Tensor:
    """The `count` numbers `[count]` of a name in the calibration `found` in `path`. ValueError where there are others."""
    values = found.get(name, [])
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{path} must give {count} numbers as {name}, got {len(values)}; fetch the file again")
    return torch.tensor(values, dtype=torch.float64)


def in_pose(values: torch.Tensor) -> torch.Tensor:
    """A pose `[4, 4]` with the first three rows `[9]` of a rotation, or `[12]` of rotation and translation."""
    out = torch.eye(4, dtype=torch.float64)
    out[:3, : len(values) // 3] = values.reshape(3, -1)
    return out


def rows_of(path: Path, count: int) -> list[list[float]]:
    """The rows of a text file of numbers. FileNotFoundError without it, ValueError where a row has less than `count` finite ones."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing; KITTI's layout has it")
    try:
        rows = [[float(word) for word in line.split()] for line in path.read_text(errors="replace").splitlines() if line.strip()]
    except ValueError as problem:
        raise ValueError(f"{path} holds something that is no number ({problem})") from None
    if not rows or any(len(row) < count for row in rows) or not all(np.isfinite(row).all() for row in rows):
        raise ValueError(f"{path} must have {count} finite numbers in every row")
    return rows


def picture_files(folder: Path, count: int, digits: int) -> tuple[Path, ...]:
    """Those of the first `count` pictures of a folder that are there (`leading`); their names are numbers of so many digits."""
    end = suffix(folder) or SUFFIXES[0]
    return leading([folder / f"{i:0{digits}d}{end}" for i in range(count)])


def suffix(folder: Path) -> str | None:
    """The suffix of the pictures in a folder; None where it has none."""
    return next((end for end in SUFFIXES if any(folder.glob(f"*{end}"))), None)


def rotation_us(stamps: np.ndarray) -> int:
    """Microseconds that the lidar takes for a rotation, by its stamps."""
    return int(np.median(np.diff(stamps))) if len(stamps) > 1 else 100_000


def read_scan(file: Path) -> np.ndarray:
    """Points `[N, 3]` in the lidar's frame, of float32 x, y, z, reflectance."""
    values = np.fromfile(file, dtype="<f4")
    if len(values) % 4:
        raise ValueError(f"{file} is cut off: {len(values)} numbers are no rows of four; fetch it again")
    xyz = values.reshape(-1, 4)[:, :3].astype(np.float64)
    return xyz[np.isfinite(xyz).all(1)]


def scan_times(places: np.ndarray, stamps: np.ndarray | int, rotation: int) -> np.ndarray:
    """When the lidar looked at places `[N, 3]` in its own frame, int64 us `[N]`: it looks ahead at `stamps`, us, and takes `rotation` us
    for a rotation."""
    return stamps + np.round(np.arctan2(places[:, 1], places[:, 0]) / (2 * np.pi) * rotation).astype(np.int64)
