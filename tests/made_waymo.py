"""The made-up recording in the layout of the Waymo Open Dataset, version 2: a parquet file a component."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from made_tape import BODY_FROM_LIDAR, MOVER, PARKED, SIZE, STAMPS, STEP_US, Tape
from PIL import Image

from scenes.poses import inverse, translation, yaw, yaw_of

NAMES = {"front": "front", "right": "front_right"}
NUMBERS = {"front": 1, "right": 3}
SEGMENT = "10017090168044687777_6380_000_6400_000"
MAP = translation(-2120.5, 9055.3, 31.0) @ yaw(0.4)
OPENCV_FROM_WAYMO = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
LENS = {"f_u": "fx", "f_v": "fy", "c_u": "cx", "c_v": "cy"}
DIRECTIONS = {"front": 1, "right": 4}
READOUT_US, EXPOSED_US, LATE_US = 24_000, 4_000, 3_000
"""How long an image is read out, each of its rows exposed, and how much later than the pose the middle row is."""
COLUMNS = 1800
"""Of a range image: at 25 m half a column is 4 cm."""


def near_points(tape: Tape) -> np.ndarray:
    """The static points that a range image holds well enough: within 25 m of the lidar at all times."""
    away = np.linalg.norm(np.stack([tape.scan(int(t)) for t in STAMPS[[0, -1]]]), axis=2).max(0)
    return tape.points[away < 25]


def write_waymo(folder: Path, tape: Tape) -> Path:
    """The folder of segments with one in it; the third sweep is lost. Row i of the top lidar's range image has point i, if any."""
    rows: dict[str, list[dict]] = {k: [] for k in ("vehicle_pose", "camera_image", "lidar", "lidar_pose", "lidar_box")}
    lens = tape.street.rig["front_camera"].lens
    intrinsic = {k: getattr(lens, v) for k, v in LENS.items()} | {k: 0.0 for k in ("k1", "k2", "p1", "p2", "k3")}
    rows["camera_calibration"] = [
        {"key.camera_name": NUMBERS[name], **{f"[CameraCalibrationComponent].intrinsic.{k}": v for k, v in intrinsic.items()},
         "[CameraCalibrationComponent].extrinsic.transform": (pose.numpy() @ OPENCV_FROM_WAYMO).ravel().tolist(),
         "[CameraCalibrationComponent].rolling_shutter_direction": DIRECTIONS[name],
         "[CameraCalibrationComponent].width": SIZE[0], "[CameraCalibrationComponent].height": SIZE[1]}
        for name, pose in tape.cameras.items()
    ]  # fmt: skip
    beams = np.linspace(-1.2, 0.4, len(tape.points))
    rows["lidar_calibration"] = [
        {"key.laser_name": 1, "[LiDARCalibrationComponent].extrinsic.transform": BODY_FROM_LIDAR.numpy().ravel().tolist(),
         "[LiDARCalibrationComponent].beam_inclination.min": -1.2, "[LiDARCalibrationComponent].beam_inclination.max": 0.4,
         "[LiDARCalibrationComponent].beam_inclination.values": beams.tolist()}
    ]  # fmt: skip
    for i, t in enumerate(STAMPS.tolist()):
        key = {"key.segment_context_name": SEGMENT, "key.frame_timestamp_micros": t}
        pose = MAP @ tape.ego.at(t)
        rows["vehicle_pose"].append({**key, "[VehiclePoseComponent].world_from_vehicle.transform": pose.numpy().ravel().tolist()})
        for name, number in NUMBERS.items():
            packed = BytesIO()
            Image.fromarray(tape.image(name, t + 10_000 * number)).save(packed, "JPEG", quality=95)
            rows["camera_image"].append(
                {**key, "key.camera_name": number, "[CameraImageComponent].image": packed.getvalue(),
                 "[CameraImageComponent].pose_timestamp": (t + 10_000 * number - LATE_US) / 1e6,
                 **{f"[CameraImageComponent].rolling_shutter_params.{k}": v for k, v in _shutter(t + 10_000 * number).items()},
                 "[CameraImageComponent].pose.transform": (MAP @ tape.ego.near(t + 10_000 * number - LATE_US)).numpy().ravel().tolist()}
            )  # fmt: skip
        for uid, box_pose, size in (("mover", tape.mover(t), MOVER), ("parked", tape.parked(), PARKED)):
            local = inverse(tape.ego.at(t)) @ box_pose @ translation(0.0, 0.0, size[2] / 2)
            keys = ("center.x", "center.y", "center.z", "size.x", "size.y", "size.z", "heading")
            values = dict(zip(keys, [*local[:3, 3].tolist(), *size.tolist(), float(yaw_of(local))], strict=True))
            box = {f"[LiDARBoxComponent].box.{k}": v for k, v in values.items()}
            rows["lidar_box"].append({**key, "key.laser_object_id": uid, "[LiDARBoxComponent].type": 1, **box})
        if i != 2:
            lidar, poses = _range_image(tape, t)
            rows["lidar"].append({**key, "key.laser_name": 1, **_flat("[LiDARComponent].range_image_return1", lidar)})
            rows["lidar_pose"].append({**key, "key.laser_name": 1, **_flat("[LiDARPoseComponent].range_image_return1", poses)})
    for kind, made in rows.items():
        (folder / kind).mkdir(parents=True)
        pd.DataFrame(made).to_parquet(folder / kind / f"{SEGMENT}.parquet", row_group_size=4)
    return folder


def _shutter(middle_us: int) -> dict[str, float]:
    half = (READOUT_US + EXPOSED_US) / 2
    return {
        "shutter": EXPOSED_US / 1e6, "camera_trigger_time": (middle_us - half) / 1e6, "camera_readout_done_time": (middle_us + half) / 1e6,
    }  # fmt: skip


def _flat(name: str, image: np.ndarray) -> dict:
    return {f"{name}.values": image.astype(np.float32).ravel(), f"{name}.shape": list(image.shape)}


def _range_image(tape: Tape, stamp: int) -> tuple[np.ndarray, np.ndarray]:
    """Range image `[H, W, 4]` and the vehicle's pose at every pixel `[H, W, 6]`: one point a row, at that row's beam.

    The beams are fixed, so each point is moved along its own direction's height to lie on one: rows and points are paired by
    how high they stand, and the pixel's pose takes up the rest.
    """
    xyz = tape.scan(stamp, STEP_US)
    count = len(xyz)
    beams = np.linspace(-1.2, 0.4, count)[::-1]
    heading = float(yaw_of(BODY_FROM_LIDAR))
    image, poses = np.zeros((count, COLUMNS, 4)), np.zeros((count, COLUMNS, 6))
    order = np.arange(count)
    for row in order:
        x, y, z = xyz[row]
        column = int((1 - (np.arctan2(y, x) + heading) / np.pi) / 2 * COLUMNS) % COLUMNS
        level = np.hypot(x, y)
        time = stamp + round(np.arctan2(y, x) / (2 * np.pi) * STEP_US)
        body = MAP @ tape.ego.near(int(time))
        on_beam = np.tan(beams[row]) * level
        lift = (BODY_FROM_LIDAR[:3, :3] @ torch.tensor([0.0, 0.0, z - on_beam], dtype=torch.float64)).numpy()
        image[row, column, 0] = np.hypot(level, on_beam)
        moved = body[:3, 3].numpy() + body[:3, :3].numpy() @ lift
        poses[row, column] = [0.0, 0.0, float(yaw_of(body)), *moved]
    return image, poses
