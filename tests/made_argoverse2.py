"""The made-up recording in the layout of Argoverse 2's sensor data set."""

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from made_tape import BODY_FROM_LIDAR, MOVER, PARKED, SIZE, STAMPS, STEP_US, Tape
from PIL import Image

from scenes.poses import inverse, quat_from_matrix, translation, yaw

NAMES = {"front": "ring_front_center", "right": "ring_front_right"}
CITY = translation(2790.1, 1610.4, 16.2) @ yaw(-0.8)
KEYS = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")


def _placed(pose: torch.Tensor) -> dict:
    return dict(zip(KEYS, [*quat_from_matrix(pose[:3, :3]).tolist(), *pose[:3, 3].tolist()], strict=True))


def write_argoverse2(folder: Path, tape: Tape) -> Path:
    """One log; the third sweep is lost. Ego poses come at every sensor's stamps, and boxes at the sweeps'."""
    (folder / "calibration").mkdir(parents=True)
    lens = tape.street.rig["front_camera"].lens
    k = {"fx_px": lens.fx, "fy_px": lens.fy, "cx_px": lens.cx, "cy_px": lens.cy, "k1": -0.25, "k2": -0.13, "k3": 0.2}
    size = {"height_px": SIZE[1], "width_px": SIZE[0]}
    rows = [{"sensor_name": name, **k, **size} for name in (*NAMES.values(), "stereo_front_left")]
    pd.DataFrame(rows).to_feather(folder / "calibration/intrinsics.feather")
    mounts = [{"sensor_name": NAMES[name], **_placed(pose)} for name, pose in tape.cameras.items()]
    mounts.append({"sensor_name": "up_lidar", **_placed(BODY_FROM_LIDAR)})
    pd.DataFrame(mounts).to_feather(folder / "calibration/egovehicle_SE3_sensor.feather")
    egos, boxes = [], []
    for i, t in enumerate(STAMPS.tolist()):
        late = {"front": 10_000, "right": 20_000}
        for moment in (t, *(t + d for d in late.values())):
            egos.append({"timestamp_ns": moment * 1000, **_placed(CITY @ tape.ego.near(moment))})
        for name, delay in late.items():
            path = folder / "sensors/cameras" / NAMES[name] / f"{(t + delay) * 1000}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(tape.image(name, t + delay)).save(path, quality=95)
        for uuid, pose, box in (("b7-mover", tape.mover(t), MOVER), ("a1-parked", tape.parked(), PARKED)):
            local = inverse(tape.ego.at(t)) @ pose @ translation(0.0, 0.0, box[2] / 2)
            sizes = dict(zip(("length_m", "width_m", "height_m"), box.tolist(), strict=True))
            boxes.append({"timestamp_ns": t * 1000, "track_uuid": uuid, "category": "REGULAR_VEHICLE", **sizes, **_placed(local)})
        if i != 2:
            xyz = tape.scan(t) @ BODY_FROM_LIDAR[:3, :3].numpy().T + BODY_FROM_LIDAR[:3, 3].numpy()
            n = len(xyz)
            sweep = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], "intensity": np.zeros(n, np.uint8), "laser_number": np.arange(n) % 64}
            path = folder / "sensors/lidar" / f"{t * 1000}.feather"
            path.parent.mkdir(exist_ok=True)
            pd.DataFrame(sweep | {"offset_ns": np.linspace(0, STEP_US * 1000, n).astype(np.int32)}).to_feather(path)
    egos.sort(key=lambda row: row["timestamp_ns"])
    pd.DataFrame(egos).to_feather(folder / "city_SE3_egovehicle.feather")
    pd.DataFrame(boxes).to_feather(folder / "annotations.feather")
    return folder
