"""The made-up recording as an NCore sequence: its file, and a stand-in for the package nvidia-ncore with the names and shapes of 19.7."""

import json
import sys
from dataclasses import dataclass, field
from enum import IntEnum
from io import BytesIO
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import torch
from made_tape import BODY_FROM_LIDAR, MOVER, PARKED, SIZE, STAMPS, STEP_US, Tape
from PIL import Image

from scenes.poses import inverse, translation, yaw, yaw_of

NAMES = {"front": "camera_front_wide_120fov", "right": "camera_cross_right_120fov"}
LIDAR = "lidar_top_360fov"
MAP = translation(310.0, -45.0, 2.0) @ yaw(0.7)
READOUT_US = 20_000
WAYS = ("TOP_TO_BOTTOM", "LEFT_TO_RIGHT", "BOTTOM_TO_TOP", "RIGHT_TO_LEFT")
Shutter = IntEnum("ShutterType", [*(f"ROLLING_{way}" for way in WAYS), "GLOBAL"])
SHUTTERS = {"front": Shutter.ROLLING_TOP_TO_BOTTOM, "right": Shutter.ROLLING_BOTTOM_TO_TOP}


def write_ncore(folder: Path) -> Path:
    """The sequence's file; what it names is in the stand-in's memory."""
    folder.mkdir(parents=True)
    interval = {"start": int(STAMPS[0]), "stop": int(STAMPS[-1]) + 1}
    meta = {"sequence_id": "made", "sequence_timestamp_interval_us": interval, "version": "4.0", "component_stores": []}
    (folder / "made.json").write_text(json.dumps(meta))
    return folder


def stand_in(tape: Tape) -> dict[str, ModuleType]:
    """The package's modules by name, for `sys.modules`."""
    package, data, v4 = (ModuleType(name) for name in ("ncore", "ncore.data", "ncore.data.v4"))
    v4.SequenceComponentGroupsReader = lambda component_group_paths, open_consolidated=True: list(component_group_paths)
    v4.SequenceLoaderV4 = lambda reader, poses_component_group_name="default": Loader(tape)
    return {"ncore": package, "ncore.data": data, "ncore.data.v4": v4}


@dataclass
class Graph:
    tape: Tape

    def evaluate_poses(self, source_node: str, target_node: str, timestamps_us: np.ndarray) -> np.ndarray:
        assert target_node == "world" and timestamps_us.dtype == np.uint64
        mounts = {"rig": torch.eye(4, dtype=torch.float64), LIDAR: BODY_FROM_LIDAR}
        mounts |= {NAMES[k]: pose for k, pose in self.tape.cameras.items()}
        return np.stack([(MAP @ self.tape.ego.near(int(t)) @ mounts[source_node]).numpy() for t in timestamps_us])


@dataclass
class Camera:
    tape: Tape
    name: str

    @property
    def frames_timestamps_us(self) -> np.ndarray:
        return np.stack([STAMPS - READOUT_US // 2, STAMPS + READOUT_US // 2], 1).astype(np.uint64)

    @property
    def model_parameters(self) -> SimpleNamespace:
        lens = self.tape.street.rig["front_camera"].lens
        plain = {"focal_length": [lens.fx, lens.fy], "principal_point": [lens.cx, lens.cy]}
        none = {"radial_coeffs": np.zeros(6), "tangential_coeffs": np.zeros(2), "thin_prism_coeffs": np.zeros(4)}
        common = {"resolution": np.array(SIZE, np.uint64), "shutter_type": SHUTTERS[self.name], "external_distortion_parameters": None}
        return SimpleNamespace(**plain, **none, **common, type=lambda: "opencv-pinhole")

    def get_frame_data(self, frame_index: int) -> SimpleNamespace:
        packed = BytesIO()
        Image.fromarray(self.tape.image(self.name, int(STAMPS[frame_index]))).save(packed, "JPEG", quality=95)
        return SimpleNamespace(get_encoded_image_data=packed.getvalue)


@dataclass
class Lidar:
    """Turns once before each stamp; the third turn is lost."""

    tape: Tape
    sensor_id: str = LIDAR
    stamps: np.ndarray = field(default_factory=lambda: np.delete(STAMPS, 2))

    @property
    def frames_timestamps_us(self) -> np.ndarray:
        return np.stack([self.stamps - STEP_US, self.stamps], 1).astype(np.uint64)

    def get_frame_point_cloud(self, frame_index: int, motion_compensation: bool, with_start_points: bool, return_index: int = 0):
        assert motion_compensation and not with_start_points
        lost = np.full((1, 3), np.nan)
        return SimpleNamespace(xyz_m_end=np.concatenate([self.tape.scan(int(self.stamps[frame_index])), lost]), xyz_m_start=None)

    def get_frame_ray_bundle_return_valid_mask(self, frame_index: int, return_index: int = 0) -> np.ndarray:
        return np.arange(len(self.tape.points) + 1) < len(self.tape.points)

    def get_frame_ray_bundle_timestamp_us(self, frame_index: int) -> np.ndarray:
        return np.full(len(self.tape.points) + 1, self.stamps[frame_index] - STEP_US // 3).astype(np.uint64)


@dataclass
class Loader:
    tape: Tape
    sequence_id: str = "made"
    generic_meta_data: dict = field(default_factory=dict)
    camera_ids: tuple = tuple(NAMES.values())
    lidar_ids: tuple = (LIDAR,)

    @property
    def pose_graph(self) -> Graph:
        return Graph(self.tape)

    def get_camera_sensor(self, sensor_id: str) -> Camera:
        return Camera(self.tape, next(k for k, v in NAMES.items() if v == sensor_id))

    def get_lidar_sensor(self, sensor_id: str) -> Lidar:
        return Lidar(self.tape)

    def get_cuboid_track_observations(self, timestamp_interval_us=None):
        for t in np.delete(STAMPS, 2).tolist():
            for track, pose, size in (("mover", self.tape.mover(t), MOVER), ("parked", self.tape.parked(), PARKED)):
                local = inverse(self.tape.ego.at(t)) @ pose @ translation(0.0, 0.0, size[2] / 2)
                box = SimpleNamespace(centroid=tuple(local[:3, 3].tolist()), dim=tuple(size.tolist()), rot=(0.0, 0.0, float(yaw_of(local))))
                where = {"reference_frame_id": "rig", "reference_frame_timestamp_us": t}
                yield SimpleNamespace(track_id=track, class_id="automobile", timestamp_us=t, bbox3=box, **where)


def install(monkeypatch, tape: Tape) -> None:
    for name, module in stand_in(tape).items():
        monkeypatch.setitem(sys.modules, name, module)
