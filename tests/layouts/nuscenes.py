"""A log in nuScenes' layout: json tables, samples/ and sweeps/, a path without heights, and a second scene to be told apart."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch

from recon.log import Log, Track
from recon.registration.corrected import moved
from scenes.poses import inverse, quat_from_matrix, translation, yaw
from scenes.trajectory import Trajectory
from tests.layouts import carried, ending, kind_of, middle_of, mount, picture, stamps

NAMES = {"front": "CAM_FRONT", "right": "CAM_FRONT_RIGHT"}
MAP = translation(411.3, 1180.9, 0.0) @ yaw(1.2)
"""Where on nuScenes' map the street lies."""
SCENE = "scene-0061"
CATEGORIES = {"pedestrian": "human.pedestrian.adult", "cyclist": "vehicle.bicycle"}


def write(folder: Path, log: Log, body_from_lidar: torch.Tensor) -> Path:
    """The scene's path, below the data set's folder.

    A sample is where boxes are; sweeps at other stamps go into sweeps/, and so do pictures that are not the nearest to one. Everything lies
    as high above the car as it did, and that at 0.
    """
    log = levelled(log)
    tables: dict[str, list[dict]] = {name: [] for name in ("sample", "sample_data", "ego_pose", "sample_annotation")}
    tables["scene"] = [{"token": "s61", "name": SCENE}, {"token": "s103", "name": "scene-0103"}]
    channels = [NAMES[name] for name in log.cameras]
    tables["sensor"] = [{"token": c, "channel": c, "modality": c[:3].lower()} for c in (*channels, "LIDAR_TOP")]
    categories = sorted({category(track) for track in log.tracks})
    tables["category"] = [{"token": name, "name": name} for name in categories]
    tables["instance"] = [{"token": track.sources[0], "category_token": category(track)} for track in log.tracks]
    mounts = {NAMES[name]: (mount(log, name), _matrix(camera.lens)) for name, camera in log.cameras.items()}
    tables["calibrated_sensor"] = [
        {"token": f"m{c}", "sensor_token": c, "camera_intrinsic": k, **_placed(pose)}
        for c, (pose, k) in (mounts | {"LIDAR_TOP": (body_from_lidar, [])}).items()
    ]
    annotated = {int(t) for track in log.tracks for t in track.times_us}
    samples = np.array(sorted(annotated or stamps(log)))
    tables["sample"] = [{"token": f"sample{i}", "timestamp": t, "scene_token": "s61"} for i, t in enumerate(samples.tolist())]

    def taken(channel: str, t: int, key: bool, end: str, size: tuple[int, int]) -> Path:
        name = Path("samples" if key else "sweeps") / channel / f"n015__{channel}__{t}{end}"
        token, sample = f"{channel}{t}", int(np.abs(samples - t).argmin())
        tables["ego_pose"].append({"token": token, "timestamp": t, **_placed(MAP @ log.ego.near(t))})
        tables["sample_data"].append(
            {"token": token, "sample_token": f"sample{sample}", "ego_pose_token": token, "calibrated_sensor_token": f"m{channel}",
             "timestamp": t, "is_key_frame": key, "filename": str(name), "width": size[0], "height": size[1]}
        )  # fmt: skip
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        return folder / name

    for name, camera in log.cameras.items():
        times = camera.times_us.numpy()
        keys = {int(np.abs(times - t).argmin()) for t in samples}
        for i, t in enumerate(times.tolist()):
            taken(NAMES[name], t, i in keys, ending(camera), (camera.width, camera.height)).write_bytes(picture(camera, i))
    for sweep in log.sweeps:
        local = carried(sweep.read().xyz, inverse(log.ego.at(sweep.time_us) @ body_from_lidar))
        file = taken("LIDAR_TOP", sweep.time_us, sweep.time_us in samples, ".pcd.bin", (0, 0))
        np.concatenate([local, np.zeros((len(local), 2))], 1).astype("<f4").tofile(file)
    for track in log.tracks:
        length, width, height = track.size.tolist()
        for t, pose in zip(track.times_us, track.world_from_box, strict=True):
            row = {"sample_token": f"sample{np.searchsorted(samples, t)}", "instance_token": track.sources[0]}
            tables["sample_annotation"].append(row | {"size": [width, length, height], **_placed(MAP @ middle_of(pose, track.size))})
    (folder / "v1.0-mini").mkdir(parents=True)
    for name, rows in tables.items():
        (folder / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    return folder / SCENE


def levelled(log: Log) -> Log:
    """The log with its car at the height 0 at all times, and all that it saw as high above it as it was."""
    down = [translation(0.0, 0.0, -float(pose[2, 3])) for pose in log.ego.world_from_body]
    return moved(log, Trajectory(log.ego.times_us, torch.stack(down)))


def category(track: Track) -> str:
    """nuScenes' name of a track's class."""
    kind = kind_of(track.label)
    return CATEGORIES.get(kind, f"{'vehicle' if kind == 'vehicle' else 'movable_object'}.{track.label}")


def _matrix(lens) -> list[list[float]]:
    return [[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]]


def _placed(pose: torch.Tensor) -> dict:
    return {"translation": pose[:3, 3].tolist(), "rotation": quat_from_matrix(pose[:3, :3]).tolist()}
