"""Reads KITTI's raw drives, synced and rectified (Geiger et al. 2013; the layout as in the devkit's readme.txt).

`<date>_drive_<n>_sync` with image_00 to image_03, oxts, velodyne_points, tracklet_labels.xml where there are any, and the three calibration
files in the folder above. The body is the IMU: x forward, y left, z up; the world is a Mercator plane. Pictures are .png, or .jpg where
someone made them smaller. A piece of a drive is read as far as its pictures and oxts go. The lidar turns counter-clockwise and looks ahead
at its stamp: its points are untwisted by the body's motion.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np
import torch

from recon.log import LidarPoints, Log, Sweep, Track, leading, lengthened
from recon.objects.tracks import Boxes, slug, tracks_of, upright
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
    suffix,
)
from recon.readers.spin import untwisted
from recon.readers.stated import rigid
from scenes.poses import inverse, yaw
from scenes.trajectory import Trajectory

EARTH = 6378137.0
"""Metres: the radius that the devkit's Mercator projection takes."""

LABELS = {"Person_sitting": "pedestrian", "Misc": "object"}


def is_kitti_raw(path: Path) -> bool:
    return (path / "oxts").is_dir() and any(path.glob("image_0[0-3]"))


def lacks_oxts(path: Path) -> bool:
    """Whether a folder would be a raw drive, but for where the car was."""
    return not (path / "oxts").is_dir() and any(path.glob("image_0[0-3]/timestamps.txt"))


def read_kitti_raw(path: Path) -> Log:
    """The raw drive in folder `path`. FileNotFoundError and ValueError name the file that is missing or wrong."""
    if path.resolve().name.endswith("_extract"):
        raise ValueError(f"{path} is the unsynced drive, whose pictures are not rectified; fetch its _sync folder")
    above = path.resolve().parent
    cams = calibration(above / "calib_cam_to_cam.txt")
    rectified = rigid(in_pose(named(cams, "R_rect_00", 9, above / "calib_cam_to_cam.txt")), f"{above / 'calib_cam_to_cam.txt'}, R_rect_00")
    rect_from_lidar = rectified @ _rigid(above / "calib_velo_to_cam.txt")
    lidar_from_imu = _rigid(above / "calib_imu_to_velo.txt")

    times = _stamps(path / "oxts" / "timestamps.txt")
    packets = [_oxts(file) for file in leading([path / "oxts" / "data" / f"{i:010d}.txt" for i in range(len(times))], "packets")]
    times, poses = times[: len(packets)], _mercator(packets)
    origin = poses[0, :3, 3].clone()
    poses[:, :3, 3] -= origin
    ego = lengthened(times, poses)
    known = int(ego.times_us[-1])
    cameras = {}
    recorded = [folder for folder in sorted(path.glob("image_0[0-3]")) if suffix(folder / "data")]
    if not recorded:
        raise FileNotFoundError(f"{path} has no pictures in image_00/data to image_03/data; fetch one camera's at least")
    for folder in recorded:  # some fetch no more than image_02, of the others there are time stamps alone
        lens, beside = projection(cams, f"P_rect_{folder.name[-2:]}", above / "calib_cam_to_cam.txt")
        body_from_cam = inverse(beside @ rect_from_lidar @ lidar_from_imu)
        stamps = _stamps(folder / "timestamps.txt")
        stamps = stamps[stamps <= known]
        files = picture_files(folder / "data", len(stamps), 10)
        world = ego.near_each(torch.from_numpy(stamps)) @ body_from_cam
        cameras[folder.name] = log_camera(folder.name, lens, files, stamps, world)
    sweeps, lidar_times = _sweeps(path / "velodyne_points", inverse(lidar_from_imu), ego)
    boxed = lidar_times if len(lidar_times) else times  # synced, a frame of the one is a frame of the other
    meta = {
        "name": f"kitti-{path.resolve().name}", "source": f"KITTI raw drive {path.resolve().name}", **SHARE,
        "body": "IMU, x forward, y left, z up", "world_origin": origin.tolist(),
        "geodetic_origin": dict(zip(("lat", "long", "height"), packets[0][:3], strict=True)),
    }  # fmt: skip
    tracks = _tracklets(path / "tracklet_labels.xml", boxed, inverse(lidar_from_imu), ego)
    return kitti_log(meta, path, cameras, sweeps, tracks, ego, inverse(lidar_from_imu)[:3, 3])


def _rigid(path: Path) -> torch.Tensor:
    """The pose `[4, 4]` that a file gives as R and T."""
    found = calibration(path)
    out = in_pose(named(found, "R", 9, path))
    out[:3, 3] = named(found, "T", 3, path)
    return rigid(out, str(path))


def _stamps(path: Path) -> np.ndarray:
    """Microseconds int64 of lines as `2011-09-26 13:02:25.964389445`."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing; KITTI's layout has it")
    times = []
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        if not line.strip():
            continue
        whole, _, part = line.strip().partition(".")
        try:
            second = int(datetime.strptime(whole + " +0000", "%Y-%m-%d %H:%M:%S %z").timestamp())
            times.append(second * 1_000_000 + int(round(float("0." + (part or "0")) * 1e6)))
        except ValueError:
            raise ValueError(f"{path}, line {number}: {line[:40]!r} is not a time as 2011-09-26 13:02:25.964389445") from None
    if not times or not (np.diff(times) > 0).all():
        raise ValueError(f"{path} must have times that rise strictly, and not none")
    return np.array(times, dtype=np.int64)


def _oxts(path: Path) -> list[float]:
    """lat, lon (degrees), alt (metres), roll, pitch, yaw (radians) and 24 more values."""
    return rows_of(path, 6)[0]


def _mercator(packets: list[list[float]]) -> torch.Tensor:
    """`world_from_imu` `[F, 4, 4]` as the devkit's convertOxtsToPose.m has it: Mercator at the first latitude, R = Rz Ry Rx."""
    lat, lon, alt, roll, pitch, heading = torch.tensor([p[:6] for p in packets], dtype=torch.float64).T
    scale = torch.cos(torch.deg2rad(lat[0]))
    out = torch.stack([yaw(float(h)) for h in heading])
    x, y = (torch.eye(3, dtype=torch.float64).repeat(len(lat), 1, 1) for _ in range(2))
    x[:, 1, 1] = x[:, 2, 2] = roll.cos()
    x[:, 2, 1], x[:, 1, 2] = roll.sin(), -roll.sin()
    y[:, 0, 0] = y[:, 2, 2] = pitch.cos()
    y[:, 0, 2], y[:, 2, 0] = pitch.sin(), -pitch.sin()
    out[:, :3, :3] = out[:, :3, :3] @ y @ x
    out[:, 0, 3] = scale * EARTH * torch.deg2rad(lon)
    out[:, 1, 3] = scale * EARTH * torch.log(torch.tan(torch.pi * (90 + lat) / 360))
    out[:, 2, 3] = alt
    return out


def _sweeps(folder: Path, body_from_lidar: torch.Tensor, ego: Trajectory) -> tuple[tuple[Sweep, ...], np.ndarray]:
    """The sweeps of a raw drive, some of which may be missing, and all their stamps, as far as the body's path is known."""
    if not folder.is_dir():
        return (), np.zeros(0, np.int64)
    times = _stamps(folder / "timestamps.txt")
    rotation = rotation_us(times)
    times = times[times <= int(ego.times_us[-1])]
    sweeps = tuple(
        Sweep(i, int(t), partial(_untwisted_sweep, file, int(t), rotation, body_from_lidar, ego))
        for i, t in enumerate(times)
        if (file := folder / "data" / f"{i:010d}.bin").is_file()
    )
    return sweeps, times


def _untwisted_sweep(file: Path, stamp: int, rotation: int, body_from_lidar: torch.Tensor, ego: Trajectory) -> LidarPoints:
    """A sweep in the world, without the twist that the body's motion gives its points."""
    xyz = read_scan(file)
    times = scan_times(xyz, stamp, rotation)
    return LidarPoints(untwisted(xyz, times, body_from_lidar, ego), times, np.zeros(len(xyz), np.int64))


def _tracklets(path: Path, times: np.ndarray, body_from_lidar: torch.Tensor, ego: Trajectory) -> tuple[Track, ...]:
    """Tracks of tracklet_labels.xml: h, w, l, and from first_frame on base centres and rz in the lidar's frame. They are drawn around
    points as they came, so each stands before the lidar where that was when it looked there: beside the car 25 ms off the stamp."""
    if not path.is_file():
        return ()
    try:
        items = ElementTree.parse(path).getroot().findall("./tracklets/item")
        found = []
        for number, item in enumerate(items):
            size = [float(item.findtext(k, "")) for k in ("l", "w", "h")]
            first = int(item.findtext("first_frame", ""))
            rows = [[float(p.findtext(k, "")) for k in ("tx", "ty", "tz", "rz")] for p in item.findall("./poses/item")]
            count = min(len(rows), len(times) - first)
            stamps = times[first : first + count]
            if count > 0:
                placed = np.array(rows[:count])
                looked = torch.from_numpy(scan_times(placed, stamps, rotation_us(times)))
                poses = ego.near_each(looked) @ body_from_lidar @ upright(placed[:, :3], placed[:, 3])
                label = slug(item.findtext("objectType", ""), LABELS)
                found.append(Boxes(str(number), label, stamps, poses, np.tile(size, (count, 1))))
    except (ElementTree.ParseError, ValueError) as problem:
        raise ValueError(f"{path} is not as KITTI writes it ({problem}); fetch it again") from None
    return tracks_of(found, ego, str(path))
