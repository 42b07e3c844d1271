"""Reads a drive in PandaSet's official layout (Xiao et al. 2021): images, json poses, pickled sweeps and cuboids.

What the format means, checked by projecting sweeps and boxes into the images: camera poses are world-from-camera in OpenCV
axes, pinhole without distortion; points and cuboids stand in the same world; the lidar pose's axes are x right, y forward,
z up; a cuboid's `dimensions.x, y, z` are width, length, height and its length runs along its own y, so heading is yaw + 90
degrees. An object seen by two lidars has two cuboid tracks that name each other as siblings.
"""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path

import numpy as np
import torch

from recon.log import LidarPoints, Log, LogCamera, Sweep, Track, image_size, leading, lengthened
from recon.objects.tracks import named, slug, upright
from recon.readers.stated import posed, stating
from recon.readers.unpickle import read_frame
from scenes.lenses import Pinhole
from scenes.poses import translation
from scenes.trajectory import Trajectory

LABELS = {
    "Medium-sized Truck": "truck",
    "Semi-truck": "truck",
    "Pickup Truck": "pickup",
    "Pedestrian with Object": "pedestrian",
    "Motorized Scooter": "scooter",
    "Other Vehicle - Construction Vehicle": "construction-vehicle",
    "Other Vehicle - Uncommon": "vehicle",
    "Other Vehicle - Pedicab": "pedicab",
    "Emergency Vehicle": "emergency-vehicle",
    "Towed Object": "trailer",
    "Cones": "cone",
}
LIDAR_FROM_BODY = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64)
LIDAR = (1.5, 0.0, 1.77)
"""Where the turning lidar stands in the body, whose place is the middle of the rear axle, metres. PandaSet does not say; seen from there
drive 002's points lie in beams, each at one elevation, and the less so the farther from there. Of the one that looks ahead nothing is
known."""

READOUT_US, MIDDLE_US = 30_000, -10_000
"""How long an image is read out, and its middle row against its stamp. PandaSet does not say; SplatAD (Hess et al. 2025) takes these."""

LATEST_S = 1e11
"""A time stamp beyond it is in milliseconds or less."""

ASTRAY_S = 1.0
"""Seconds between a sweep's stamp and its points' times that no lidar explains: clocks of two kinds, or a file of another place."""

PICKLES = (".pkl.gz", ".pkl")
FRONT = ("front_camera", "front_left_camera", "front_right_camera")


def is_pandaset(path: Path) -> bool:
    return (path / "camera").is_dir()


def read_pandaset(path: Path) -> Log:
    """The drive in folder `path`. FileNotFoundError and ValueError name the file that is missing or wrong."""
    lidar_times, lidar_poses = _stamped(path / "lidar")
    body = lidar_poses @ LIDAR_FROM_BODY
    origin = body[0, :3, 3].clone()
    home = translation(*(-origin).tolist())
    cameras = {folder.name: _camera(folder, home) for folder in sorted((path / "camera").iterdir()) if folder.is_dir()}
    if not cameras:
        raise ValueError(f"{path / 'camera'} holds no camera; PandaSet's has front_camera and five more")
    cameras = dict(sorted(cameras.items(), key=lambda item: (item[0] != "front_camera", item[0])))
    ego = lengthened(lidar_times, home @ body)
    sweeps = tuple(
        Sweep(i, int(t), partial(_points, file, int(t), origin.numpy()))
        for i, t in enumerate(lidar_times)
        if (file := _pickle(path / "lidar", i)) is not None
    )
    meta = {
        "name": f"pandaset-{path.resolve().name}",
        "source": f"PandaSet drive {path.resolve().name}",
        "licence": "CC BY 4.0",
        "attribution": "PandaSet by Hesai and Scale AI",
        "body": "lidar pose, turned to x forward, y left, z up",
        "world_origin": origin.tolist(),
        **_geodetic(path / "meta" / "gps.json"),
    }
    tracks = _tracks(path, lidar_times, origin.numpy(), ego)
    front, lidars = tuple(n for n in FRONT if n in cameras), {0: np.array(LIDAR)}
    return Log(meta["name"], path, cameras, sweeps, tracks, ego, meta, front, lidars=lidars)


def _json(path: Path):
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing; PandaSet's layout has it")
    try:
        return json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as problem:
        raise ValueError(f"{path} is not json ({problem}); fetch the file again") from None


def _stamped(folder: Path) -> tuple[np.ndarray, torch.Tensor]:
    """Times int64 us `[F]` and poses float64 `[F, 4, 4]` of a sensor's folder."""
    times, poses = _json(folder / "timestamps.json"), _json(folder / "poses.json")
    try:
        seconds = np.asarray(times, dtype=np.float64)
        quats = torch.tensor([[p["heading"][k] for k in "wxyz"] for p in poses], dtype=torch.float64)
        places = torch.tensor([[p["position"][k] for k in "xyz"] for p in poses], dtype=torch.float64)
    except (KeyError, TypeError, ValueError) as problem:
        raise ValueError(f"{folder / 'poses.json'} or timestamps.json is not as PandaSet writes it ({problem!r})") from None
    if not (np.abs(seconds) < LATEST_S).all():
        raise ValueError(f"{folder / 'timestamps.json'} must give seconds, finite and since 1970 at most; got {seconds.flat[0]:.16g}")
    times_us = np.round(seconds * 1e6).astype(np.int64)
    if times_us.ndim != 1 or len(times_us) != len(poses) or not len(poses):
        raise ValueError(f"{folder} has {times_us.size} timestamps and {len(poses)} poses; they must be as many, and not none")
    if not (np.diff(times_us) > 0).all():
        raise ValueError(f"{folder / 'timestamps.json'} does not rise strictly at entry {int(np.argmin(np.diff(times_us) > 0)) + 1}")
    return times_us, posed(quats, places, str(folder / "poses.json"))


def _camera(folder: Path, home: torch.Tensor) -> LogCamera:
    times_us, poses = _stamped(folder)
    files = leading([folder / f"{i:02d}.jpg" for i in range(len(times_us))])
    width, height = image_size(files[0])
    lens = _json(folder / "intrinsics.json")
    with stating(f"{folder / 'intrinsics.json'} must give numbers fx, fy, cx, cy"):
        pinhole = Pinhole(*(float(lens[k]) for k in ("fx", "fy", "cx", "cy")))
    middles, world_from_cam = (values[: len(files)] for values in _middles(times_us, home @ poses))
    return LogCamera(folder.name, pinhole, width, height, files, middles, world_from_cam, "rows", READOUT_US)


def _middles(times_us: np.ndarray, poses: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Times and poses of the images' middle rows, of those at the stamps."""
    middles = torch.from_numpy(times_us + MIDDLE_US)
    return middles, lengthened(times_us, poses).at_each(middles)


def _pickle(folder: Path, index: int) -> Path | None:
    return next((folder / f"{index:02d}{end}" for end in PICKLES if (folder / f"{index:02d}{end}").is_file()), None)


def _points(file: Path, stamp: int, origin: np.ndarray) -> LidarPoints:
    table = read_frame(file)
    missing = [k for k in "xyzt" if k not in table]
    if missing:
        raise ValueError(f"{file} has no column {missing[0]!r}; it has {', '.join(table)}")
    xyz = np.stack([table[k].astype(np.float64) for k in "xyz"], 1) - origin
    keep = np.isfinite(xyz).all(1) & np.isfinite(table["t"].astype(np.float64))
    sensor = table["d"].astype(np.int64) if "d" in table else np.zeros(len(xyz), np.int64)
    times = np.round(table["t"][keep].astype(np.float64) * 1e6).astype(np.int64)
    if len(times) and abs(off := float(np.median(times - stamp)) / 1e6) > ASTRAY_S:
        raise ValueError(f"{file}: its points were taken {abs(off):.3g} s {'after' if off > 0 else 'before'} its stamp in timestamps.json")
    return LidarPoints(xyz[keep], times, sensor[keep])


def _geodetic(path: Path) -> dict:
    if not path.is_file():
        return {}
    try:
        told = [{k: float(fix[k]) for k in ("lat", "long", "height")} for fix in _json(path)]
    except (KeyError, TypeError, ValueError) as problem:
        raise ValueError(f"{path} is not as PandaSet writes it ({problem!r})") from None
    # receivers begin with NaN; a later place will do for what it is asked for, where the sun stood
    return next(({"geodetic_origin": place} for place in told if np.isfinite(list(place.values())).all()), {})


def _observations(path: Path, count: int) -> dict[str, list[dict]]:
    """Every cuboid by its track's uuid, in time order: frame index and the row."""
    found: dict[str, list[dict]] = {}
    folder = path / "annotations" / "cuboids"
    files = {index: file for index in range(count) if (file := _pickle(folder, index)) is not None}
    if files and len(files) < count:
        first = next(i for i in range(count) if i not in files)
        print(f"{folder} has the boxes of {len(files)} of {count} sweeps, and not {first:02d}{PICKLES[0]}: fetch all", file=sys.stderr)
    for index, file in files.items():
        table = read_frame(file)
        needed = ["uuid", "label", "yaw", "stationary", *(f"{a}.{k}" for a in ("position", "dimensions") for k in "xyz")]
        missing = [k for k in needed if k not in table]
        if missing:
            raise ValueError(f"{file} has no column {missing[0]!r}; it has {', '.join(table)}")
        for row in range(len(table["uuid"])):
            entry = {k: table[k][row] for k in needed}
            entry["sibling"] = str(table["cuboids.sibling_id"][row]) if "cuboids.sibling_id" in table else "-"
            entry["sensor"] = int(table["cuboids.sensor_id"][row]) if "cuboids.sensor_id" in table else -1
            found.setdefault(str(entry["uuid"]), []).append({**entry, "frame": index, "file": file})
    return found


def _tracks(path: Path, times_us: np.ndarray, origin: np.ndarray, ego: Trajectory) -> tuple[Track, ...]:
    observed = _observations(path, len(times_us))
    made = []
    for sources in _families(observed):
        # the sibling seen longest leads, the spinning lidar's (0) on a tie; the others fill the frames it lacks
        sources.sort(key=lambda u: (-len(observed[u]), observed[u][0]["sensor"], u))
        by_frame: dict[int, dict] = {}
        for uuid in sources:
            for entry in observed[uuid]:
                by_frame.setdefault(entry["frame"], entry)
        entries = [by_frame[f] for f in sorted(by_frame)]
        lead = observed[sources[0]]
        size = np.median([[e["dimensions.y"], e["dimensions.x"], e["dimensions.z"]] for e in lead], axis=0)
        if not (np.isfinite(size).all() and (size > 0).all()):
            raise ValueError(f"{lead[0]['file']}: cuboid {sources[0]} must have positive dimensions, got {size.tolist()}")
        base = np.array([[e["position.x"], e["position.y"], e["position.z"] - e["dimensions.z"] / 2] for e in entries]) - origin
        poses = upright(base, np.array([e["yaw"] for e in entries], dtype=np.float64) + np.pi / 2)
        if not torch.isfinite(poses).all():
            raise ValueError(f"{lead[0]['file']}: cuboid {sources[0]} stands at a place that is not finite")
        label = slug(str(lead[0]["label"]), LABELS)
        moving = any(not bool(e["stationary"]) for u in sources for e in observed[u])
        times = np.array([times_us[e["frame"]] for e in entries])
        sensor = np.array([e["sensor"] for e in entries])
        made.append(Track("", label, moving, size, times, poses, sensor, tuple(sources)))
    return named(made, ego)


def _families(observed: dict[str, list[dict]]) -> list[list[str]]:
    """Tracks joined wherever one names another as its sibling."""
    parent = {u: u for u in observed}

    def root(u: str) -> str:
        while parent[u] != u:
            u = parent[u]
        return u

    for uuid, entries in observed.items():
        for sibling in {e["sibling"] for e in entries} & observed.keys():
            parent[root(uuid)] = root(sibling)
    families: dict[str, list[str]] = {}
    for uuid in observed:
        families.setdefault(root(uuid), []).append(uuid)
    return list(families.values())
