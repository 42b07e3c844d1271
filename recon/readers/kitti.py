"""Reads KITTI's raw drives and odometry sequences (Geiger et al. 2013; the layouts as in the devkits' readme.txt).

Raw, synced and rectified: `<date>_drive_<n>_sync` with image_00 to image_03, oxts, velodyne_points, tracklet_labels.xml where there are
any, and the three calibration files in the folder above. The body is the IMU: x forward, y left, z up; the world is a Mercator plane.
Pictures are .png, or .jpg where someone made them smaller. A piece of a drive is read as far as its pictures and oxts go.
The lidar turns counter-clockwise and looks ahead at its stamp: its points are untwisted by the body's motion.

Odometry: `sequences/<n>` with image_0 to image_3, velodyne, calib.txt, times.txt and the poses in `../../poses/<n>.txt`. The body is the
lidar, whose points are published untwisted; the first camera, turned, where a calibration without lidar's `Tr` came with pictures alone.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np
import torch

from recon.log import LidarPoints, Log, LogCamera, Sweep, Track, image_size, leading, lengthened
from recon.readers.spin import untwisted
from recon.readers.stated import rigid, stating
from recon.tracks import Boxes, slug, tracks_of, upright
from scenes.lenses import Pinhole
from scenes.poses import CAM_FROM_FLU, inverse, translation, yaw
from scenes.trajectory import Trajectory

EARTH = 6378137.0
"""Metres: the radius that the devkit's Mercator projection takes."""

LABELS = {"Person_sitting": "pedestrian", "Misc": "object"}
SHARE = {"licence": "CC BY-NC-SA 3.0", "attribution": "KITTI by Geiger, Lenz, Stiller and Urtasun"}
SUFFIXES = (".png", ".jpg")
FRONT = ("image_02", "image_2", "image_00", "image_0")


def is_kitti_raw(path: Path) -> bool:
    return (path / "oxts").is_dir() and any(path.glob("image_0[0-3]"))


def lacks_oxts(path: Path) -> bool:
    """Whether a folder would be a raw drive, but for where the car was."""
    return not (path / "oxts").is_dir() and any(path.glob("image_0[0-3]/timestamps.txt"))


def is_kitti_odometry(path: Path) -> bool:
    return (path / "calib.txt").is_file() and (path / "times.txt").is_file()


def read_kitti_raw(path: Path) -> Log:
    """The raw drive in folder `path`. FileNotFoundError and ValueError name the file that is missing or wrong."""
    if path.resolve().name.endswith("_extract"):
        raise ValueError(f"{path} is the unsynced drive, whose pictures are not rectified; fetch its _sync folder")
    above = path.resolve().parent
    cams = _numbers(above / "calib_cam_to_cam.txt")
    rectified = rigid(_padded(_named(cams, "R_rect_00", 9, above / "calib_cam_to_cam.txt")), f"{above / 'calib_cam_to_cam.txt'}, R_rect_00")
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
    recorded = [folder for folder in sorted(path.glob("image_0[0-3]")) if _suffix(folder / "data")]
    if not recorded:
        raise FileNotFoundError(f"{path} has no pictures in image_00/data to image_03/data; fetch one camera's at least")
    for folder in recorded:  # some fetch no more than image_02, of the others there are time stamps alone
        lens, beside = _projection(cams, f"P_rect_{folder.name[-2:]}", above / "calib_cam_to_cam.txt")
        body_from_cam = inverse(beside @ rect_from_lidar @ lidar_from_imu)
        stamps = _stamps(folder / "timestamps.txt")
        stamps = stamps[stamps <= known]
        files = _files(folder / "data", len(stamps), 10)
        world = ego.near_each(torch.from_numpy(stamps)) @ body_from_cam
        cameras[folder.name] = _camera(folder.name, lens, files, stamps, world)
    sweeps, lidar_times = _spinning(path / "velodyne_points", inverse(lidar_from_imu), ego)
    boxed = lidar_times if len(lidar_times) else times  # synced, a frame of the one is a frame of the other
    meta = {
        "name": f"kitti-{path.resolve().name}", "source": f"KITTI raw drive {path.resolve().name}", **SHARE,
        "body": "IMU, x forward, y left, z up", "world_origin": origin.tolist(),
        "geodetic_origin": dict(zip(("lat", "long", "height"), packets[0][:3], strict=True)),
    }  # fmt: skip
    tracks = _tracklets(path / "tracklet_labels.xml", boxed, inverse(lidar_from_imu), ego)
    return _log(meta, path, cameras, sweeps, tracks, ego, inverse(lidar_from_imu)[:3, 3])


def read_kitti_odometry(path: Path) -> Log:
    """The odometry sequence in folder `path`. FileNotFoundError and ValueError name the file that is missing or wrong."""
    number = path.resolve().name
    times = np.round(np.array(_rows(path / "times.txt", 1))[:, 0] * 1e6).astype(np.int64)
    if not (np.diff(times) > 0).all():
        raise ValueError(f"{path / 'times.txt'} must have seconds that rise strictly; fetch it again")
    where = next((p for p in (path / "poses.txt", path.resolve().parents[1] / "poses" / f"{number}.txt") if p.is_file()), None)
    if where is None:
        missing = path.resolve().parents[1] / "poses" / f"{number}.txt"
        raise FileNotFoundError(f"{missing} is missing; KITTI publishes poses of the sequences 00 to 10, for others write your own there")
    rows = np.array(_rows(where, 12)).reshape(-1, 3, 4)
    if len(rows) != len(times):
        raise ValueError(f"{where} has {len(rows)} poses for the {len(times)} times of {path / 'times.txt'}; they must be as many")
    camera_world = torch.eye(4, dtype=torch.float64).repeat(len(rows), 1, 1)
    camera_world[:, :3] = torch.from_numpy(rows)
    camera_world = rigid(camera_world, str(where))
    calib = _numbers(path / "calib.txt")
    blind = "Tr" not in calib and not (path / "velodyne").is_dir()  # the calibration that comes with grey pictures knows no lidar
    mount = CAM_FROM_FLU if blind else _padded(_named(calib, "Tr", 12, path / "calib.txt"))
    cam_from_body = rigid(mount, f"{path / 'calib.txt'}, Tr")
    # the poses' world is the first rectified camera; ours is the first body pose, turned to where up is in the mean: it may be on a slope
    poses = _levelled(inverse(camera_world[0] @ cam_from_body) @ camera_world @ cam_from_body)
    ego = lengthened(times, poses)
    cameras = {}
    for folder in sorted(path.glob("image_[0-3]")):
        lens, beside = _projection(calib, f"P{folder.name[-1]}", path / "calib.txt")
        files = _files(folder, len(times), 6)
        world = poses @ inverse(beside @ cam_from_body)
        cameras[folder.name] = _camera(folder.name, lens, files, times, world)
    sweeps = tuple(
        Sweep(i, int(t), partial(_scan, file, poses[i], int(t), _turn_us(times)))
        for i, t in enumerate(times)
        if (file := path / "velodyne" / f"{i:06d}.bin").is_file()
    )
    meta = {
        "name": f"kitti-odometry-{number}", "source": f"KITTI odometry sequence {number}", **SHARE,
        "body": f"{'first camera' if blind else 'lidar'}, x forward, y left, z up",
    }  # fmt: skip
    return _log(meta, path, cameras, sweeps, (), ego, torch.zeros(3, dtype=torch.float64))


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


def _log(meta: dict, path: Path, cameras: dict, sweeps: tuple, tracks: tuple, ego: Trajectory, lidar: torch.Tensor) -> Log:
    if not cameras:
        raise ValueError(f"{path} holds no camera; KITTI's colour cameras are image_02 and image_03 (odometry: image_2 and image_3)")
    front = next((n for n in FRONT if n in cameras), next(iter(cameras)))
    cameras = dict(sorted(cameras.items(), key=lambda item: (item[0] != front, item[0])))
    return Log(meta["name"], path, cameras, sweeps, tracks, ego, meta, (front,), lidars={0: lidar.numpy()})


def _camera(name: str, lens: Pinhole, files: tuple[Path, ...], times: np.ndarray, world: torch.Tensor) -> LogCamera:
    """times `[F]`, world: `world_from_cam` `[F, 4, 4]`, of all frames, of which `files` are the first."""
    return LogCamera(name, lens, *image_size(files[0]), files, torch.from_numpy(times[: len(files)]), world[: len(files)])


def _projection(found: dict[str, list[float]], name: str, path: Path) -> tuple[Pinhole, torch.Tensor]:
    """Lens and `cam_from_rect` `[4, 4]` of a camera's projection K [I | t]: t is its place beside the reference camera."""
    p = _named(found, name, 12, path).reshape(3, 4)
    with stating(f"{path}, {name}"):
        # the devkit counts pixel centres from 0, we from 0.5
        lens = Pinhole(float(p[0, 0]), float(p[1, 1]), float(p[0, 2]) + 0.5, float(p[1, 2]) + 0.5)
        return lens, translation(*torch.linalg.solve(p[:, :3], p[:, 3]).tolist())


def _numbers(path: Path) -> dict[str, list[float]]:
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


def _named(found: dict[str, list[float]], name: str, count: int, path: Path) -> torch.Tensor:
    values = found.get(name, [])
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{path} must give {count} numbers as {name}, got {len(values)}; fetch the file again")
    return torch.tensor(values, dtype=torch.float64)


def _padded(values: torch.Tensor) -> torch.Tensor:
    out = torch.eye(4, dtype=torch.float64)
    out[:3, : len(values) // 3] = values.reshape(3, -1)
    return out


def _rigid(path: Path) -> torch.Tensor:
    """The pose `[4, 4]` that a file gives as R and T."""
    found = _numbers(path)
    out = _padded(_named(found, "R", 9, path))
    out[:3, 3] = _named(found, "T", 3, path)
    return rigid(out, str(path))


def _rows(path: Path, count: int) -> list[list[float]]:
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing; KITTI's layout has it")
    try:
        rows = [[float(word) for word in line.split()] for line in path.read_text(errors="replace").splitlines() if line.strip()]
    except ValueError as problem:
        raise ValueError(f"{path} holds something that is no number ({problem})") from None
    if not rows or any(len(row) < count for row in rows) or not all(np.isfinite(row).all() for row in rows):
        raise ValueError(f"{path} must have {count} finite numbers in every row")
    return rows


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


def _files(folder: Path, count: int, digits: int) -> tuple[Path, ...]:
    end = _suffix(folder) or SUFFIXES[0]
    return leading([folder / f"{i:0{digits}d}{end}" for i in range(count)])


def _suffix(folder: Path) -> str | None:
    """How the pictures of a folder end; None where it has none."""
    return next((end for end in SUFFIXES if any(folder.glob(f"*{end}"))), None)


def _oxts(path: Path) -> list[float]:
    """lat, lon (degrees), alt (metres), roll, pitch, yaw (radians) and 24 more values."""
    return _rows(path, 6)[0]


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


def _turn_us(stamps: np.ndarray) -> int:
    """How long the lidar takes to turn once, by its stamps."""
    return int(np.median(np.diff(stamps))) if len(stamps) > 1 else 100_000


def _spinning(folder: Path, body_from_lidar: torch.Tensor, ego: Trajectory) -> tuple[tuple[Sweep, ...], np.ndarray]:
    """The sweeps of a raw drive, some of which may be missing, and all their stamps, as far as the body's path is known."""
    if not folder.is_dir():
        return (), np.zeros(0, np.int64)
    times = _stamps(folder / "timestamps.txt")
    turn = _turn_us(times)
    times = times[times <= int(ego.times_us[-1])]
    sweeps = tuple(
        Sweep(i, int(t), partial(_turn, file, int(t), turn, body_from_lidar, ego))
        for i, t in enumerate(times)
        if (file := folder / "data" / f"{i:010d}.bin").is_file()
    )
    return sweeps, times


def _read_scan(file: Path) -> np.ndarray:
    """Points `[N, 3]` in the lidar's frame, of float32 x, y, z, reflectance."""
    values = np.fromfile(file, dtype="<f4")
    if len(values) % 4:
        raise ValueError(f"{file} is cut off: {len(values)} numbers are no rows of four; fetch it again")
    xyz = values.reshape(-1, 4)[:, :3].astype(np.float64)
    return xyz[np.isfinite(xyz).all(1)]


def _looked(places: np.ndarray, stamps: np.ndarray | int, turn: int) -> np.ndarray:
    """When the lidar looked at places `[N, 3]` in its own frame, int64 us `[N]`, in turns of a length in us that look ahead at `stamps`."""
    return stamps + np.round(np.arctan2(places[:, 1], places[:, 0]) / (2 * np.pi) * turn).astype(np.int64)


def _turn(file: Path, stamp: int, turn: int, body_from_lidar: torch.Tensor, ego: Trajectory) -> LidarPoints:
    xyz = _read_scan(file)
    times = _looked(xyz, stamp, turn)
    return LidarPoints(untwisted(xyz, times, body_from_lidar, ego), times, np.zeros(len(xyz), np.int64))


def _scan(file: Path, world_from_lidar: torch.Tensor, stamp: int, turn: int) -> LidarPoints:
    """An untwisted sweep: what drives was where it stands in it when the lidar looked there."""
    local = _read_scan(file)
    xyz = local @ world_from_lidar[:3, :3].numpy().T + world_from_lidar[:3, 3].numpy()
    return LidarPoints(xyz, _looked(local, stamp, turn), np.zeros(len(xyz), np.int64))


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
                looked = torch.from_numpy(_looked(placed, stamps, _turn_us(times)))
                poses = ego.near_each(looked) @ body_from_lidar @ upright(placed[:, :3], placed[:, 3])
                label = slug(item.findtext("objectType", ""), LABELS)
                found.append(Boxes(str(number), label, stamps, poses, np.tile(size, (count, 1))))
    except (ElementTree.ParseError, ValueError) as problem:
        raise ValueError(f"{path} is not as KITTI writes it ({problem}); fetch it again") from None
    return tracks_of(found, ego, str(path))
