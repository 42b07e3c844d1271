"""Reads a log of Argoverse 2's sensor data set (Wilson et al. 2021; the layout as in the user guide's page "Sensor Dataset").

A log's folder has sensors/cameras/<name>/<ns>.jpg, sensors/lidar/<ns>.feather, calibration/intrinsics.feather and
egovehicle_SE3_sensor.feather, city_SE3_egovehicle.feather and, in train and val, annotations.feather. Pictures are published undistorted:
the k1 to k3 of their calibration are history (av2-api, issue 219). Sweeps stand in the ego frame at their stamp, both lidars in one,
free of the car's own motion; `offset_ns` tells when a point was taken. Boxes stand in the ego frame, by their middles.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import torch

from recon.log import LidarPoints, Log, LogCamera, Sweep, lengthened
from recon.objects.tracks import Boxes, from_middles, slug, tracks_of
from recon.readers.arrow import read_table
from recon.readers.stated import posed, stating
from scenes.lenses import Pinhole
from scenes.poses import translation
from scenes.trajectory import Trajectory

FRONT = ("ring_front_center", "ring_front_left", "ring_front_right")
LIDARS = ("up_lidar", "down_lidar")
"""By the number that their points get."""
LABELS = {
    "REGULAR_VEHICLE": "car", "LARGE_VEHICLE": "truck", "BOX_TRUCK": "truck", "TRUCK_CAB": "truck", "SCHOOL_BUS": "bus",
    "ARTICULATED_BUS": "bus", "VEHICULAR_TRAILER": "trailer", "RAILED_VEHICLE": "tram", "BICYCLIST": "cyclist", "MOTORCYCLIST": "cyclist",
    "WHEELED_RIDER": "cyclist", "CONSTRUCTION_CONE": "cone", "WHEELCHAIR": "pedestrian", "OFFICIAL_SIGNALER": "pedestrian",
}  # fmt: skip
POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")


def is_argoverse2(path: Path) -> bool:
    return (path / "city_SE3_egovehicle.feather").is_file() or (path / "sensors" / "cameras").is_dir()


def read_argoverse2(path: Path) -> Log:
    """The log in folder `path`. FileNotFoundError and ValueError name the file or column that is missing or wrong."""
    where = path / "city_SE3_egovehicle.feather"
    table = read_table(where, ("timestamp_ns", *POSE))
    order = np.argsort(table["timestamp_ns"])
    if not len(order):
        raise ValueError(f"{where} has no row; fetch it again")
    bodies = _poses(table, where)[torch.from_numpy(order)]
    origin = bodies[0, :3, 3].clone()
    home = translation(*(-origin).tolist())
    times, first = np.unique(_us(table["timestamp_ns"][order]), return_index=True)
    ego = lengthened(times, home @ bodies[torch.from_numpy(first)])

    lens_keys = ("sensor_name", "fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
    lenses = read_table(path / "calibration" / "intrinsics.feather", lens_keys)
    mounted = path / "calibration" / "egovehicle_SE3_sensor.feather"
    mounts = read_table(mounted, ("sensor_name", *POSE))
    mount_of = dict(zip(mounts["sensor_name"], _poses(mounts, mounted), strict=True))
    cameras = {}
    for row, name in enumerate(lenses["sensor_name"]):
        files = _stamped(path / "sensors" / "cameras" / str(name), ".jpg")
        files = [(t, f) for t, f in files if ego.covers(t)]
        if not files:  # a log may come with some of its cameras only
            continue
        if name not in mount_of:
            raise ValueError(f"{mounted} does not say where {name} stands")
        with stating(f"{path / 'calibration' / 'intrinsics.feather'}, {name}"):
            lens = Pinhole(*(float(lenses[k][row]) for k in ("fx_px", "fy_px", "cx_px", "cy_px")))
        stamps = torch.tensor([t for t, _ in files])
        poses = ego.at_each(stamps) @ mount_of[name]
        size = int(lenses["width_px"][row]), int(lenses["height_px"][row])
        cameras[str(name)] = LogCamera(str(name), lens, *size, tuple(f for _, f in files), stamps, poses)
    if not cameras:
        raise ValueError(f"{path / 'sensors/cameras'} holds no picture of the cameras {', '.join(map(str, lenses['sensor_name']))}")
    cameras = dict(sorted(cameras.items(), key=lambda item: (item[0] != FRONT[0], item[0])))
    lidar = [(t, f) for t, f in _stamped(path / "sensors" / "lidar", ".feather") if ego.covers(t)]
    sweeps = tuple(Sweep(i, t, partial(_points, f, t, ego)) for i, (t, f) in enumerate(lidar))
    meta: dict = {
        "name": f"argoverse2-{path.resolve().name}", "source": f"Argoverse 2 log {path.resolve().name}", "licence": "CC BY-NC-SA 4.0",
        "attribution": "Argoverse 2 by Argo AI", "body": "ego frame, x forward, y left, z up", "world_origin": origin.tolist(),
    }  # fmt: skip
    tracks = _tracks(path / "annotations.feather", ego)
    lidars = {k: mount_of[name][:3, 3].numpy() for k, name in enumerate(LIDARS) if name in mount_of}
    front = tuple(n for n in FRONT if n in cameras)
    return Log(meta["name"], path, cameras, sweeps, tracks, ego, meta, front, lidars=lidars)


def _us(nanoseconds: np.ndarray) -> np.ndarray:
    return (np.asarray(nanoseconds, dtype=np.int64) + 500) // 1000


def _poses(table: dict[str, np.ndarray], path: Path) -> torch.Tensor:
    quats, places = (torch.from_numpy(np.stack([table[k] for k in keys], 1).astype(np.float64)) for keys in (POSE[:4], POSE[4:]))
    return posed(quats, places, str(path))


def _stamped(folder: Path, end: str) -> list[tuple[int, Path]]:
    """Files named by their nanoseconds, in the order of time, in microseconds."""
    files = [f for f in folder.glob(f"*{end}") if f.stem.isdecimal()] if folder.is_dir() else []
    return sorted(((int(f.stem) + 500) // 1000, f) for f in files)


def _points(file: Path, stamp: int, ego: Trajectory) -> LidarPoints:
    table = read_table(file, ("x", "y", "z", "offset_ns"))
    xyz = np.stack([table[k].astype(np.float64) for k in "xyz"], 1)
    keep = np.isfinite(xyz).all(1)
    pose = ego.at(stamp).numpy()
    times = stamp + table["offset_ns"][keep].astype(np.int64) // 1000
    sensor = table["laser_number"][keep].astype(np.int64) // 32 if "laser_number" in table else np.zeros(keep.sum(), np.int64)
    return LidarPoints(xyz[keep] @ pose[:3, :3].T + pose[:3, 3], times, sensor)


def _tracks(path: Path, ego: Trajectory) -> tuple:
    if not path.is_file():  # the test split has none
        return ()
    table = read_table(path, ("timestamp_ns", "track_uuid", "category", "length_m", "width_m", "height_m", *POSE))
    stamps = torch.from_numpy(_us(table["timestamp_ns"]))
    sizes = np.stack([table[k] for k in ("length_m", "width_m", "height_m")], 1).astype(np.float64)
    covered = ego.covers_each(stamps)
    poses = ego.near_each(stamps) @ from_middles(_poses(table, path), sizes[:, 2])
    found = []
    for uuid in dict.fromkeys(table["track_uuid"].tolist()):
        mine = np.flatnonzero((table["track_uuid"] == uuid) & covered.numpy())
        if len(mine):
            label = slug(str(table["category"][mine[0]]), LABELS)
            found.append(Boxes(str(uuid), label, stamps.numpy()[mine], poses[mine], sizes[mine]))
    return tracks_of(found, ego, str(path))
