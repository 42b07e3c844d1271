"""The made-up recording as an NCore sequence, written by the package nvidia-ncore itself."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from made_tape import BODY_FROM_LIDAR, MOVER, PARKED, SIZE, STAMPS, STEP_US, Tape
from ncore.data import BBox3, CuboidTrackObservation, LabelSource, OpenCVPinholeCameraModelParameters, ShutterType
from ncore.data.v4 import (
    CameraSensorComponent,
    CuboidsComponent,
    IntrinsicsComponent,
    LidarSensorComponent,
    MasksComponent,
    PosesComponent,
    SequenceComponentGroupsReader,
    SequenceComponentGroupsWriter,
)
from ncore.impl.common.transformations import HalfClosedInterval
from PIL import Image
from upath import UPath

from scenes.poses import inverse, translation, yaw

NAMES = {"front": "camera_front_wide_120fov", "right": "camera_cross_right_120fov"}
LIDAR = "lidar_top_360fov"
MAP = translation(310.0, -45.0, 2.0) @ yaw(0.7)
READOUT_US = 20_000
LOST: int | slice = 2
"""Which of the lidar's turns."""
SHUTTERS = {"front": ShutterType.ROLLING_TOP_TO_BOTTOM, "right": ShutterType.ROLLING_BOTTOM_TO_TOP}
EGO = Image.fromarray(np.arange(54)[:, None].repeat(96, 1) >= 50)


@dataclass
class Sensor:
    """A camera or lidar: `rig_from_sensor` `[4, 4]`, and its frames: first and last moment, and what was taken."""

    mount: np.ndarray
    frames: Iterable[tuple[int, int, object]]
    model: object = None
    mask: Image.Image | None = None


def write_sequence(folder: Path, name: str, times_us, poses, cameras: dict, lidars: dict, cuboids: list | None) -> Path:
    """A sequence in `folder`: `world_from_rig` `[F, 4, 4]` at `times_us`, cameras (what they took: JPEG bytes), lidars (ray directions,
    moments and distances; raw, NaN where nothing came back), and what stands where; without masks and cuboids where those are None."""
    folder.mkdir(parents=True)
    times = np.asarray(times_us, np.uint64)
    span = HalfClosedInterval.from_start_end(int(times[0]), int(times[-1]))
    writer = SequenceComponentGroupsWriter(UPath(folder), name, name, span, {"license": "made up"})

    def of(component, instance="default"):
        return writer.register_component_writer(component.Writer, instance, None if instance == "default" else instance)

    graph, intrinsics = of(PosesComponent), of(IntrinsicsComponent)
    masks = None if cuboids is None else of(MasksComponent)
    graph.store_dynamic_pose("rig", "world", np.asarray(poses, np.float64), times)
    for sensor, s in (cameras | lidars).items():
        graph.store_static_pose(sensor, "rig", np.asarray(s.mount, np.float64))
    for camera, s in cameras.items():
        intrinsics.store_camera_intrinsics(camera, s.model)
        if masks is not None:
            masks.store_camera_masks(camera, {"ego": s.mask} if s.mask else {})
        frames = of(CameraSensorComponent, camera)
        for first, last, jpeg in s.frames:
            frames.store_frame(jpeg, "jpeg", np.array([first, last], np.uint64), {}, {})
    for lidar, s in lidars.items():
        frames = of(LidarSensorComponent, lidar)
        for first, last, (directions, moments, distances) in s.frames:
            bright = np.where(np.isfinite(distances), 0.5, np.nan)[None].astype(np.float32)
            rays = directions.astype(np.float32), moments.astype(np.uint64), None, distances[None].astype(np.float32), bright
            frames.store_frame(*rays, np.array([first, last], np.uint64), {}, {})
    if cuboids is not None:
        of(CuboidsComponent).store_observations(cuboids)
    meta = SequenceComponentGroupsReader(writer.finalize()).get_sequence_meta().to_dict()
    (folder / f"{name}.json").write_text(json.dumps(meta))
    return folder


def cuboid(track: str, label: str, time_us: int, rig_from_box: np.ndarray, size: np.ndarray) -> CuboidTrackObservation:
    """What stands upright on its base centre `rig_from_box`, seen from the rig."""
    centre = rig_from_box @ np.array([0, 0, size[2] / 2, 1])
    turned = (0.0, 0.0, float(np.arctan2(rig_from_box[1, 0], rig_from_box[0, 0])))
    box = BBox3(tuple(map(float, centre[:3])), tuple(map(float, size)), turned)
    return CuboidTrackObservation(track, label, int(time_us), "rig", int(time_us), box, LabelSource.EXTERNAL)


def pinhole(lens, size: tuple[int, int], shutter: ShutterType) -> OpenCVPinholeCameraModelParameters:
    several = {"principal_point": (lens.cx, lens.cy), "focal_length": (lens.fx, lens.fy)}
    none = {"radial_coeffs": np.zeros(6), "tangential_coeffs": np.zeros(2), "thin_prism_coeffs": np.zeros(4)}
    numbers = {k: np.array(v, np.float32) for k, v in (several | none).items()}
    return OpenCVPinholeCameraModelParameters(resolution=np.array(size, np.uint64), shutter_type=shutter, **numbers)


def write_ncore(folder: Path, tape: Tape, annotated: bool = True) -> Path:
    """The tape, with what is known of its pictures or without; the lidar turns once before each stamp, and one turn is lost."""

    def pictures(name: str):
        for t in STAMPS.tolist():
            packed = BytesIO()
            Image.fromarray(tape.image(name, t)).save(packed, "JPEG", quality=95)
            yield t - READOUT_US // 2, t + READOUT_US // 2, packed.getvalue()

    def turns():
        for t in np.delete(STAMPS, LOST).tolist():
            taken = t - STEP_US // 3
            xyz = np.concatenate([tape.scan(taken), [[1.0, 0.0, 0.0]]])
            far = np.linalg.norm(xyz, axis=1)
            directions, far[-1] = xyz / far[:, None], np.nan
            yield t - STEP_US, t, (directions, np.full(len(far), taken), far)

    seen = []
    for t in np.delete(STAMPS, LOST).tolist():
        for track, pose, size in (("mover", tape.mover(t), MOVER), ("parked", tape.parked(), PARKED)):
            seen.append(cuboid(track, "automobile", t, (inverse(tape.ego.at(t)) @ pose).numpy(), size))
    lens = tape.street.rig["front_camera"].lens
    cameras = {
        NAMES[k]: Sensor(pose, pictures(k), pinhole(lens, SIZE, SHUTTERS[k]), EGO if k == "front" else None)
        for k, pose in tape.cameras.items()
    }
    lidars = {LIDAR: Sensor(BODY_FROM_LIDAR, turns())}
    return write_sequence(folder, "made", tape.ego.times_us, MAP @ tape.ego.world_from_body, cameras, lidars, seen if annotated else None)
