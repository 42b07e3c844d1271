"""The made-up recording in nuScenes' layout: json tables, samples, and a second scene to be told apart."""

import json
from pathlib import Path

import numpy as np
import torch
from made_tape import BODY_FROM_LIDAR, MOVER, PARKED, STAMPS, Tape
from PIL import Image

from scenes.poses import quat_from_matrix, translation, yaw

NAMES = {"front": "CAM_FRONT", "right": "CAM_FRONT_RIGHT"}
MAP = translation(411.3, 1180.9, 0.0) @ yaw(1.2)
"""Where on nuScenes' map the street lies."""


def _placed(pose: torch.Tensor) -> dict:
    return {"translation": pose[:3, 3].tolist(), "rotation": quat_from_matrix(pose[:3, :3]).tolist()}


def write_nuscenes(folder: Path, tape: Tape) -> Path:
    """The data set's folder with scene-0061; the third sweep is no key frame and lost, as where sweeps/ was not fetched."""
    tables = {name: [] for name in ("sample", "sample_data", "ego_pose", "sample_annotation")}
    tables["scene"] = [{"token": "s61", "name": "scene-0061"}, {"token": "s103", "name": "scene-0103"}]
    tables["sensor"] = [{"token": c, "channel": c, "modality": c[:3].lower()} for c in (*NAMES.values(), "LIDAR_TOP")]
    tables["category"] = [{"token": "c", "name": "vehicle.car"}]
    tables["instance"] = [{"token": i, "category_token": "c"} for i in ("mover", "parked")]
    lens = tape.street.rig["front_camera"].lens
    k = [[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]]
    mounts = {ours: (tape.cameras[name], k) for name, ours in NAMES.items()} | {"LIDAR_TOP": (BODY_FROM_LIDAR, [])}
    tables["calibrated_sensor"] = [
        {"token": f"m{c}", "sensor_token": c, "camera_intrinsic": k, **_placed(pose)} for c, (pose, k) in mounts.items()
    ]
    for i, t in enumerate(STAMPS.tolist()):
        tables["sample"].append({"token": f"sample{i}", "timestamp": t, "scene_token": "s61"})
        for channel, late in (("CAM_FRONT", 10_000), ("CAM_FRONT_RIGHT", 20_000), ("LIDAR_TOP", 0)):
            key = i != 2 or channel != "LIDAR_TOP"
            end = "pcd.bin" if channel == "LIDAR_TOP" else "png"
            name = Path("samples" if key else "sweeps") / channel / f"n015__{channel}__{t + late}.{end}"
            token = f"{channel}{i}"
            tables["ego_pose"].append({"token": token, "timestamp": t + late, **_placed(MAP @ tape.ego.near(t + late))})
            tables["sample_data"].append(
                {"token": token, "sample_token": f"sample{i}", "ego_pose_token": token, "calibrated_sensor_token": f"m{channel}",
                 "timestamp": t + late, "is_key_frame": key, "filename": str(name), "width": 96, "height": 54}
            )  # fmt: skip
            if key:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                if channel == "LIDAR_TOP":
                    np.concatenate([tape.scan(t), np.zeros((len(tape.points), 2))], 1).astype("<f4").tofile(folder / name)
                else:
                    camera = {v: n for n, v in NAMES.items()}[channel]
                    Image.fromarray(tape.image(camera, t + late)).save(folder / name)
        for instance, pose, size in (("mover", tape.mover(t), MOVER), ("parked", tape.parked(), PARKED)):
            middle = MAP @ pose @ translation(0.0, 0.0, size[2] / 2)
            length, width, height = size.tolist()
            row = {"sample_token": f"sample{i}", "instance_token": instance, "size": [width, length, height], **_placed(middle)}
            tables["sample_annotation"].append(row)
    (folder / "v1.0-mini").mkdir(parents=True)
    for name, rows in tables.items():
        (folder / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    return folder
