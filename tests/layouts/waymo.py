"""A log in the layout of the Waymo Open Dataset, version 2: a parquet file a component, lidar as range images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import torch

from recon.log import LidarPoints, Log
from recon.readers.waymo import SHUTTERS
from scenes.poses import CAM_FROM_FLU, inverse, translation, yaw, yaw_of
from scenes.trajectory import Trajectory
from tests.layouts import carried, kind_of, middle_of, mount, picture, stamps

NUMBERS = {"front": 1, "right": 3}
SEGMENT = "10017090168044687777_6380_000_6400_000"
MAP = translation(-2120.5, 9055.3, 31.0) @ yaw(0.4)
LENS = {"f_u": "fx", "f_v": "fy", "c_u": "cx", "c_v": "cy"}
TYPES = {"vehicle": 1, "pedestrian": 2, "cyclist": 4, "object": 0}
EXPOSED_US, LATE_US = 4_000, 3_000
"""How long each row of an image is exposed, and how much later than the pose the middle row is."""


def write(folder: Path, log: Log, body_from_lidar: torch.Tensor, beams: np.ndarray, columns: int) -> Path:
    """The segment's path, below the folder of segments.

    A frame begins with each stamp of a sweep or box; its pictures follow, and its pose is the front one's. beams: radians above the
    horizon, rising, `[H]`: a range image is `[H, columns]`, and its pixels' poses take up what a point is off its pixel's ray.
    """
    rows: dict[str, list[dict]] = {k: [] for k in ("vehicle_pose", "camera_image", "lidar", "lidar_pose", "lidar_box")}
    rows["camera_calibration"] = [_calibrated(log, name) for name in log.cameras]
    rows["lidar_calibration"] = [
        {"key.laser_name": 1, "[LiDARCalibrationComponent].extrinsic.transform": body_from_lidar.numpy().ravel().tolist(),
         "[LiDARCalibrationComponent].beam_inclination.min": float(beams[0]),
         "[LiDARCalibrationComponent].beam_inclination.max": float(beams[-1]),
         "[LiDARCalibrationComponent].beam_inclination.values": beams.tolist()}
    ]  # fmt: skip
    frames = np.array(stamps(log))
    poses = {t: MAP @ log.ego.at(t) for t in frames.tolist()}
    for name, camera in log.cameras.items():
        for i, t in enumerate(camera.times_us.tolist()):
            frame = int(frames[np.searchsorted(frames, t, side="right") - 1])
            pose = MAP @ log.ego.near(t - LATE_US)
            if name == "front":
                poses[frame] = pose
            shutter = {f"[CameraImageComponent].rolling_shutter_params.{k}": v for k, v in _shutter(t, camera.readout_us).items()}
            rows["camera_image"].append(
                {**_key(frame), "key.camera_name": NUMBERS[name], "[CameraImageComponent].image": picture(camera, i), **shutter,
                 "[CameraImageComponent].pose_timestamp": (t - LATE_US) / 1e6,
                 "[CameraImageComponent].pose.transform": pose.numpy().ravel().tolist()}
            )  # fmt: skip
    transform = "[VehiclePoseComponent].world_from_vehicle.transform"
    rows["vehicle_pose"] = [{**_key(t), transform: pose.numpy().ravel().tolist()} for t, pose in poses.items()]
    for track in log.tracks:
        about = {"key.laser_object_id": track.sources[0], "[LiDARBoxComponent].type": TYPES[kind_of(track.label)]}
        about |= {f"[LiDARBoxComponent].box.size.{k}": v for k, v in zip("xyz", track.size.tolist(), strict=True)}
        for t, pose in zip(track.times_us.tolist(), track.world_from_box, strict=True):
            local = inverse(poses[t]) @ MAP @ middle_of(pose, track.size)
            where = {f"[LiDARBoxComponent].box.center.{k}": v for k, v in zip("xyz", local[:3, 3].tolist(), strict=True)}
            rows["lidar_box"].append({**_key(t), **about, **where, "[LiDARBoxComponent].box.heading": float(yaw_of(local))})
    for sweep in log.sweeps:
        ranges, pixels = range_image(sweep.read(), log.ego, body_from_lidar, beams, columns)
        rows["lidar"].append({**_key(sweep.time_us), "key.laser_name": 1, **_flat("[LiDARComponent].range_image_return1", ranges)})
        rows["lidar_pose"].append({**_key(sweep.time_us), "key.laser_name": 1, **_flat("[LiDARPoseComponent].range_image_return1", pixels)})
    for kind, made in rows.items():
        (folder / kind).mkdir(parents=True)
        pd.DataFrame(made).to_parquet(folder / kind / f"{SEGMENT}.parquet", row_group_size=4)
    return folder / SEGMENT


def range_image(
    points: LidarPoints, ego: Trajectory, body_from_lidar: torch.Tensor, beams: np.ndarray, columns: int
) -> tuple[np.ndarray, np.ndarray]:
    """Ranges `[H, columns, 4]` and the vehicle's pose at every pixel `[H, columns, 6]`: roll, pitch, yaw and place. Of several points in
    one pixel the nearest stays."""
    moments, which = np.unique(points.times_us, return_inverse=True)
    bodies = ego.near_each(torch.from_numpy(moments))[which]
    local = carried(points.xyz, inverse(bodies @ body_from_lidar))
    away = np.linalg.norm(local, axis=1)
    heading = float(yaw_of(body_from_lidar))
    azimuth = np.arctan2(local[:, 1], local[:, 0])
    column = ((1 - (azimuth + heading) / np.pi) / 2 * columns).astype(int) % columns
    inclination = np.arcsin(local[:, 2] / away)
    row = np.abs(beams[::-1, None] - inclination).argmin(0)
    order = np.argsort(-away, kind="stable")  # the nearest is written last
    at = row[order], column[order]
    image, pixels = np.zeros((len(beams), columns, 4), np.float32), np.zeros((len(beams), columns, 6), np.float32)
    image[at[0], at[1], 0] = away[order]
    # from the pixel's ray to the point's: the vehicle is turned about the lidar
    centre = (1 - 2 * (column + 0.5) / columns) * np.pi - heading
    turn = _turned(azimuth, inclination) @ np.swapaxes(_turned(centre, beams[::-1][row]), 1, 2)
    mounted = body_from_lidar[:3, :3].numpy()
    world = (MAP @ bodies).numpy()
    rotation = world[:, :3, :3] @ mounted @ turn @ mounted.T
    lidar = world[:, :3, :3] @ body_from_lidar[:3, 3].numpy() + world[:, :3, 3]
    place = lidar - rotation @ body_from_lidar[:3, 3].numpy()
    angles = [
        np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2]),
        -np.arcsin(rotation[:, 2, 0]),
        np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]),
    ]
    pixels[at[0], at[1]] = np.column_stack([*angles, place])[order]
    return image, pixels


def _turned(azimuth: np.ndarray, inclination: np.ndarray) -> np.ndarray:
    """Rotations `[N, 3, 3]` that take x to directions."""
    (ca, ci), (sa, si) = np.cos([azimuth, inclination]), np.sin([azimuth, inclination])
    rows = [[ca * ci, -sa, -ca * si], [sa * ci, ca, -sa * si], [si, 0 * si, ci]]
    return np.stack([np.stack(r, -1) for r in rows], -2)


def _calibrated(log: Log, name: str) -> dict:
    camera = log.cameras[name]
    ways = {way: number for number, way in SHUTTERS.items()}
    lens = {k: getattr(camera.lens, v) for k, v in LENS.items()} | {k: 0.0 for k in ("k1", "k2", "p1", "p2", "k3")}
    return {
        "key.camera_name": NUMBERS[name], **{f"[CameraCalibrationComponent].intrinsic.{k}": v for k, v in lens.items()},
        "[CameraCalibrationComponent].extrinsic.transform": (mount(log, name) @ CAM_FROM_FLU).numpy().ravel().tolist(),
        "[CameraCalibrationComponent].rolling_shutter_direction": ways.get((camera.shutter, int(np.sign(camera.readout_us))), 5),
        "[CameraCalibrationComponent].width": camera.width, "[CameraCalibrationComponent].height": camera.height,
    }  # fmt: skip


def _shutter(middle_us: int, readout_us: int) -> dict[str, float]:
    half = (abs(readout_us) + EXPOSED_US) / 2
    return {
        "shutter": EXPOSED_US / 1e6, "camera_trigger_time": (middle_us - half) / 1e6, "camera_readout_done_time": (middle_us + half) / 1e6,
    }  # fmt: skip


def _key(stamp: int) -> dict:
    return {"key.segment_context_name": SEGMENT, "key.frame_timestamp_micros": stamp}


def _flat(name: str, image: np.ndarray) -> dict:
    return {f"{name}.values": image.ravel(), f"{name}.shape": list(image.shape)}
