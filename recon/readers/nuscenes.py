"""Reads a scene of nuScenes from its json tables (Caesar et al. 2020; the tables as in the devkit's docs/schema_nuscenes.md).

`nuscenes/scene-0061`: the data set's folder, with samples/, perhaps sweeps/, and a v1.0-*/ of tables, then the scene's name. The body is
the ego frame (rear axle, x forward, y left, z up), the world the map less its place at the start; its height is always 0. Boxes are
annotated at 2 Hz, centres and sizes as width, length, height. Sweeps are published free of the car's own motion, without a time for each
point: the lidar turns clockwise, 20 times a second, until the sweep's stamp, and cameras are triggered as it comes across the middle of
what they see (forum.nuscenes.org, topic 245), so their stamps tell when it looked where.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TextIO

import numpy as np
import torch

from recon.log import LidarPoints, Log, LogCamera, Sweep, Track, lengthened
from recon.objects.tracks import Boxes, from_middles, slug, tracks_of
from recon.readers.stated import posed, stating
from scenes.lenses import Pinhole
from scenes.names import unknown
from scenes.poses import translation
from scenes.trajectory import Trajectory

FRONT = ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT")
LABELS = {
    "construction": "construction-vehicle", "emergency": "emergency-vehicle", "trafficcone": "cone", "adult": "pedestrian",
    "child": "pedestrian", "construction_worker": "pedestrian", "police_officer": "pedestrian", "stroller": "pedestrian",
    "wheelchair": "pedestrian", "personal_mobility": "scooter",
}  # fmt: skip

TURN_US = 50_000
"""How long the lidar takes to turn once."""

AGREE = 0.95
"""Length of the mean of unit vectors from which on cameras agree where the lidar looked: those that are 3 ms apart come to 0.98."""


def is_nuscenes(path: Path) -> bool:
    """Whether a path is the data set's folder, or one of its scenes (which need be no folder)."""
    return any((root / "samples").is_dir() and any(root.glob("v1.0-*")) for root in (path, path.parent))


def read_nuscenes(path: Path) -> Log:
    """The scene that `path` names. FileNotFoundError and ValueError name what is missing: scene, table, key or file."""
    root, name = (path, None) if (path / "samples").is_dir() else (path.parent, path.name)
    tables, scene = _scene(root, name)
    samples = {s["token"]: s for s in tables.rows("sample") if s["scene_token"] == scene["token"]}
    taken = sorted((d for d in tables.rows("sample_data") if d["sample_token"] in samples), key=lambda d: d["timestamp"])
    if not taken:
        raise ValueError(f"{tables.folder / 'sample_data.json'} has nothing of {scene['name']}; fetch the tables of the part that has it")
    mounts, sensors = (Keyed(tables, name) for name in ("calibrated_sensor", "sensor"))
    egos = Keyed(tables, "ego_pose", {d["ego_pose_token"] for d in taken})
    moments = {int(row["timestamp"]): _pose(row) for row in egos.values()}
    times = np.array(sorted(moments), dtype=np.int64)
    bodies = torch.stack([moments[int(t)] for t in times])
    origin = bodies[0, :3, 3].clone()
    home = translation(*(-origin).tolist())
    ego = lengthened(times, home @ bodies)

    by_channel: dict[str, list[dict]] = {}
    for d in taken:
        # frames between the annotated ones come as a download of their own, which need not be there
        if d["is_key_frame"] or (root / d["filename"]).is_file():
            by_channel.setdefault(sensors[mounts[d["calibrated_sensor_token"]]["sensor_token"]]["channel"], []).append(d)
    cameras, sweeps, lidars = {}, [], {}
    ends = _ends(by_channel, mounts)
    for channel, frames in sorted(by_channel.items(), key=lambda item: (item[0] != FRONT[0], item[0])):
        mount = mounts[frames[0]["calibrated_sensor_token"]]
        files = tuple(root / d["filename"] for d in frames)
        lost = next((f for f in files if not f.is_file()), None)
        if lost is not None and (channel.startswith("CAM") or channel == "LIDAR_TOP"):
            raise FileNotFoundError(f"{lost} is missing; {tables.folder / 'sample_data.json'} names it: fetch the part that has it")
        poses = torch.stack([home @ _pose(egos[d["ego_pose_token"]]) @ _pose(mount) for d in frames])
        stamps = torch.tensor([int(d["timestamp"]) for d in frames])
        if channel.startswith("CAM"):
            with stating(f"{tables.folder / 'calibrated_sensor.json'}, camera_intrinsic of {channel}"):
                k = mount["camera_intrinsic"]
                lens = Pinhole(float(k[0][0]), float(k[1][1]), float(k[0][2]), float(k[1][2]))
            cameras[channel] = LogCamera(channel, lens, int(frames[0]["width"]), int(frames[0]["height"]), files, stamps, poses)
        elif channel == "LIDAR_TOP":
            when, lidars = stamps.tolist(), {0: _pose(mount)[:3, 3].numpy()}
            turned = None if ends is None else ends - _heading(_pose(mount)[:3, 0])
            sweeps = [Sweep(i, t, partial(_points, files[i], poses[i], t, turned)) for i, t in enumerate(when)]
    if not cameras:
        raise ValueError(f"{scene['name']} in {tables.folder} has no camera; nuScenes' are CAM_FRONT and five more")
    meta: dict = {
        "name": f"nuscenes-{scene['name']}", "source": f"nuScenes {scene['name']}", "licence": "CC BY-NC-SA 4.0",
        "attribution": "nuScenes by Motional", "body": "ego frame, x forward, y left, z up", "world_origin": origin.tolist(),
        "heights": False,
    }  # fmt: skip
    tracks = _tracks(tables, samples, by_channel.get("LIDAR_TOP", []), home, ego)
    front = tuple(n for n in FRONT if n in cameras)
    return Log(meta["name"], path, cameras, tuple(sweeps), tracks, ego, meta, front, lidars=lidars)


class Tables:
    """The tables of one version, of which the whole data set's have millions of rows: they are read one by one, none is kept."""

    def __init__(self, folder: Path):
        self.folder = folder

    def rows(self, name: str) -> Iterator[dict]:
        """The rows of a table, as they are read. FileNotFoundError, ValueError naming the file."""
        path = self.folder / f"{name}.json"
        if not path.is_file():
            raise FileNotFoundError(f"{path} is missing; nuScenes' metadata comes as a download of its own: unpack it there")
        keys = frozenset(KEYS[name])
        with open(path, encoding="utf-8") as file:
            for row in _entries(file, path):
                if not isinstance(row, dict) or not keys <= row.keys():
                    lost = next(key for key in KEYS[name] if not isinstance(row, dict) or key not in row)
                    raise ValueError(f'{path} has rows without "{lost}"; it is not as nuScenes writes it')
                yield row


class Keyed(dict[str, dict]):
    """A table's rows by their tokens, of those `wanted` where some are. ValueError naming the table for a token that it lacks."""

    def __init__(self, tables: Tables, name: str, wanted: set[str] | None = None):
        self.path = tables.folder / f"{name}.json"
        super().__init__((row["token"], row) for row in tables.rows(name) if wanted is None or row["token"] in wanted)

    def __missing__(self, token: str) -> dict:
        raise ValueError(f"{self.path} has no row {token}, which other tables name; fetch the tables again")


CHUNK = 1 << 20
"""Characters of a table that are read at once: a row has some hundreds."""
BEGIN, NEXT = re.compile(r"\s*\[\s*(\])?\s*"), re.compile(r"\s*(?:,|(\]))\s*")
"""What stands before a list's first entry and after each; with a group where that ends the list."""


def _entries(file: TextIO, path: Path) -> Iterator:
    """The entries of a json list, one at a time. ValueError naming the file where it is none, or is cut off."""
    decode, count = json.JSONDecoder().raw_decode, 0
    try:
        text = file.read(CHUNK)
        mark = BEGIN.match(text)
        while mark and not mark[1]:
            entry, at = decode(text, mark.end())
            yield entry
            count += 1
            if len(text) - at < CHUNK and (more := file.read(CHUNK)):  # else the next entry may be cut
                text, at = text[at:] + more, 0
            mark = NEXT.match(text, at)
        if not mark or mark.end() < len(text):
            raise ValueError("it is not one whole list")
    except ValueError as problem:
        why = problem.msg if isinstance(problem, json.JSONDecodeError) else problem
        raise ValueError(f"{path} is not json ({why}, after {count} rows); fetch it again") from None


KEYS = {
    "scene": ("token", "name"),
    "sample": ("token", "timestamp", "scene_token"),
    "sample_data": (
        "sample_token", "ego_pose_token", "calibrated_sensor_token", "timestamp", "is_key_frame", "filename", "width", "height",
    ),
    "calibrated_sensor": ("token", "sensor_token", "translation", "rotation", "camera_intrinsic"),
    "sensor": ("token", "channel"),
    "ego_pose": ("token", "timestamp", "translation", "rotation"),
    "sample_annotation": ("sample_token", "instance_token", "translation", "size", "rotation"),
    "instance": ("token", "category_token"),
    "category": ("token", "name"),
}  # fmt: skip


def _scene(root: Path, name: str | None) -> tuple[Tables, dict]:
    """The tables that have the named scene, and its row; without a name, the only scene there is."""
    known: dict[str, tuple[Tables, dict]] = {}
    for folder in sorted(p for p in root.glob("v1.0-*") if p.is_dir()):
        tables = Tables(folder)
        known |= {row["name"]: (tables, row) for row in tables.rows("scene")}
    if name is None and len(known) == 1:
        return next(iter(known.values()))
    if name is None:
        some = ", ".join(list(known)[:8]) or "none"
        raise ValueError(f"{root} holds {len(known)} scenes ({some}); name one, as {root / next(iter(known), 'scene-0061')}")
    if name not in known:
        raise ValueError(unknown("scene", name, str(root), known))
    return known[name]


def _pose(row: dict) -> torch.Tensor:
    """The pose of a row's translation (metres) and rotation (wxyz)."""
    try:
        quat, place = (torch.tensor(row[key], dtype=torch.float64) for key in ("rotation", "translation"))
        return posed(quat.reshape(4), place.reshape(3), f"row {row.get('token', '?')} of nuScenes' tables")
    except (TypeError, RuntimeError) as problem:
        raise ValueError(f"row {row.get('token', '?')} of nuScenes' tables has no pose ({problem})") from None


def _heading(direction: torch.Tensor) -> float:
    """Radians counter-clockwise from ahead of a direction `[3]` in the ego frame."""
    return float(torch.atan2(direction[1], direction[0]))


def _ends(by_channel: dict[str, list[dict]], mounts: dict[str, dict]) -> float | None:
    """Where the lidar looks at its stamps, in radians counter-clockwise from ahead, by the cameras of key frames: the sooner before the
    stamp one was triggered, the less the lidar had turned. None where cameras do not agree, or there is no lidar."""
    stamps = {d["sample_token"]: int(d["timestamp"]) for d in by_channel.get("LIDAR_TOP", ()) if d["is_key_frame"]}
    looked = []
    for d in (d for channel, frames in by_channel.items() if channel.startswith("CAM") for d in frames):
        if d["is_key_frame"] and d["sample_token"] in stamps:
            before = (stamps[d["sample_token"]] - int(d["timestamp"])) / TURN_US
            looked.append(_heading(_pose(mounts[d["calibrated_sensor_token"]])[:3, 2]) - 2 * np.pi * before)
    mean = np.exp(1j * np.array(looked)).mean() if looked else 0j
    return float(np.angle(mean)) if abs(mean) > AGREE else None


def _points(file: Path, world_from_lidar: torch.Tensor, stamp: int, ends: float | None) -> LidarPoints:
    """A sweep of float32 x, y, z, intensity, ring, in the lidar's frame, in which it `ends` at an angle; all at its stamp where None."""
    values = np.fromfile(file, dtype="<f4")
    if len(values) % 5:
        raise ValueError(f"{file} is cut off: {len(values)} numbers are no rows of five; fetch it again")
    local = values.reshape(-1, 5)[:, :3].astype(np.float64)
    local = local[np.isfinite(local).all(1)]
    ago = np.zeros(len(local)) if ends is None else (np.arctan2(local[:, 1], local[:, 0]) - ends) % (2 * np.pi) / (2 * np.pi)
    xyz = local @ world_from_lidar[:3, :3].numpy().T + world_from_lidar[:3, 3].numpy()
    return LidarPoints(xyz, stamp - np.round(ago * TURN_US).astype(np.int64), np.zeros(len(xyz), np.int64))


def _tracks(tables: Tables, samples: dict, sweeps: list[dict], home: torch.Tensor, ego: Trajectory) -> tuple[Track, ...]:
    """Tracks of the annotated instances, at the time of their sample's own sweep."""
    if not (tables.folder / "sample_annotation.json").is_file():
        return ()
    at = {token: int(s["timestamp"]) for token, s in samples.items()}
    at |= {d["sample_token"]: int(d["timestamp"]) for d in sweeps if d["is_key_frame"]}
    classes, instances = (Keyed(tables, name) for name in ("category", "instance"))
    seen: dict[str, list[dict]] = {}
    for row in tables.rows("sample_annotation"):
        if row["sample_token"] in samples:
            seen.setdefault(row["instance_token"], []).append(row)
    found = []
    for instance, rows in seen.items():
        times = np.array([at[row["sample_token"]] for row in rows], dtype=np.int64)
        sizes = np.array([[row["size"][1], row["size"][0], row["size"][2]] for row in rows])
        poses = home @ from_middles(torch.stack([_pose(row) for row in rows]), sizes[:, 2])
        found.append(Boxes(instance, label_of(classes[instances[instance]["category_token"]]["name"]), times, poses, sizes))
    return tracks_of(found, ego, str(tables.folder / "sample_annotation.json"))


def label_of(category: str) -> str:
    """`vehicle.bus.rigid` is bus, `human.pedestrian.adult` pedestrian, `movable_object.trafficcone` cone."""
    parts = category.split(".")
    return slug(next((p for p in parts[1:] if p in LABELS), parts[min(1, len(parts) - 1)]), LABELS)
