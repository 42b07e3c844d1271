"""A log in the layout of Argoverse 2's sensor data set: feather tables, and pictures named by their nanoseconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import torch

from recon.log import Log
from recon.readers.argoverse2 import LABELS, LIDARS
from scenes.poses import inverse, quat_from_matrix, translation, yaw
from tests.layouts import carried, middle_of, mount, picture, stamps

NAMES = {"front": "ring_front_center", "right": "ring_front_right"}
CITY = translation(2790.1, 1610.4, 16.2) @ yaw(-0.8)
KEYS = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
CATEGORIES = {ours: theirs for theirs, ours in reversed(LABELS.items())}
"""The first of the data set's classes that is read as ours."""


def write(folder: Path, log: Log) -> Path:
    """The folder, of one log. Ego poses come at every sensor's stamps, and boxes, in the ego frame, at the sweeps'."""
    (folder / "calibration").mkdir(parents=True)
    rows = [
        {"sensor_name": NAMES[name], "fx_px": c.lens.fx, "fy_px": c.lens.fy, "cx_px": c.lens.cx, "cy_px": c.lens.cy,
         "k1": -0.25, "k2": -0.13, "k3": 0.2, "height_px": c.height, "width_px": c.width}
        for name, c in log.cameras.items()
    ]  # fmt: skip
    rows.append({**rows[0], "sensor_name": "stereo_front_left"})
    pd.DataFrame(rows).to_feather(folder / "calibration/intrinsics.feather")
    mounts = [{"sensor_name": NAMES[name], **_placed(mount(log, name))} for name in log.cameras]
    mounts += [{"sensor_name": LIDARS[k], **_placed(translation(*place.tolist()))} for k, place in log.lidars.items()]
    pd.DataFrame(mounts).to_feather(folder / "calibration/egovehicle_SE3_sensor.feather")
    for name, camera in log.cameras.items():
        there = folder / "sensors/cameras" / NAMES[name]
        there.mkdir(parents=True)
        for i, t in enumerate(camera.times_us.tolist()):
            (there / f"{t * 1000}.jpg").write_bytes(picture(camera, i))
    (folder / "sensors/lidar").mkdir()
    for sweep in log.sweeps:
        points = sweep.read()
        xyz = carried(points.xyz, inverse(log.ego.at(sweep.time_us)))
        table = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], "intensity": np.zeros(len(xyz), np.uint8)}
        table |= {
            "laser_number": (32 * points.sensor).astype(np.uint8),
            "offset_ns": (1000 * (points.times_us - sweep.time_us)).astype(np.int32),
        }
        pd.DataFrame(table).to_feather(folder / "sensors/lidar" / f"{sweep.time_us * 1000}.feather")
    moments = sorted({*stamps(log), *(t for camera in log.cameras.values() for t in camera.times_us.tolist())})
    poses = CITY @ log.ego.near_each(torch.tensor(moments))
    egos = [{"timestamp_ns": 1000 * t, **_placed(pose)} for t, pose in zip(moments, poses, strict=True)]
    pd.DataFrame(egos).to_feather(folder / "city_SE3_egovehicle.feather")
    boxes = []
    for track in log.tracks:
        about = {"track_uuid": track.sources[0], "category": CATEGORIES.get(track.label, track.label.upper().replace("-", "_"))}
        about |= dict(zip(("length_m", "width_m", "height_m"), track.size.tolist(), strict=True))
        local = inverse(log.ego.at_each(torch.from_numpy(track.times_us))) @ middle_of(track.world_from_box, track.size)
        boxes += [{"timestamp_ns": 1000 * t, **about, **_placed(p)} for t, p in zip(track.times_us.tolist(), local, strict=True)]
    pd.DataFrame(boxes).to_feather(folder / "annotations.feather")
    return folder


def _placed(pose: torch.Tensor) -> dict:
    return dict(zip(KEYS, [*quat_from_matrix(pose[:3, :3]).tolist(), *pose[:3, 3].tolist()], strict=True))
