"""Reads a segment of the Waymo Open Dataset, version 2 (Sun et al. 2020; columns as in waymo_open_dataset/v2/perception).

`waymo/training/<segment>`: the folder that has camera_image/, camera_calibration/, vehicle_pose/, and lidar/, lidar_calibration/,
lidar_pose/, lidar_box/ where lidar and boxes are wanted, then the segment's name, a parquet file in each of them. The body is the
vehicle frame; cameras look along their own x, with y left and z up, through OpenCV's lens. Lidar comes as range images: of the top lidar
with a pose a pixel, since it turns while the car drives. A frame's stamp is that of its first lidar column, and its pose that of its front
picture, some 50 ms later (waymo-open-dataset, issues 464 and 541).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import torch

from recon.log import LidarPoints, Log, LogCamera, Packed, Sweep, lengthened
from recon.objects.tracks import Boxes, from_middles, tracks_of, upright
from recon.readers.arrow import Rows, read_cell, read_table
from recon.readers.stated import rigid, stating
from scenes.lenses import OpenCV
from scenes.names import unknown
from scenes.poses import CAM_FROM_FLU, inverse, translation
from scenes.trajectory import Trajectory

CAMERAS = {1: "front", 2: "front_left", 3: "front_right", 4: "side_left", 5: "side_right"}
LABELS = {1: "car", 2: "pedestrian", 3: "sign", 4: "cyclist"}
FRONT = ("front", "front_left", "front_right")
IMAGE = "[CameraImageComponent].image"
WHEN = "key.frame_timestamp_micros"
BODY = "[VehiclePoseComponent].world_from_vehicle.transform"
STAMP, POSE = "[CameraImageComponent].pose_timestamp", "[CameraImageComponent].pose.transform"
READ = tuple(f"[CameraImageComponent].rolling_shutter_params.{k}" for k in ("shutter", "camera_trigger_time", "camera_readout_done_time"))
TAKEN = ("key.camera_name", WHEN, STAMP, POSE, *READ)
RANGES, PIXELS = "[LiDARComponent].range_image_return1", "[LiDARPoseComponent].range_image_return1"
SWEPT = {
    "lidar": ("key.laser_name", f"{RANGES}.values", f"{RANGES}.shape"),
    "lidar_pose": ("key.laser_name", f"{PIXELS}.values", f"{PIXELS}.shape"),
    "vehicle_pose": (BODY,),
}
"""What a sweep is made of: columns by component."""
SHUTTERS = {1: ("rows", 1), 2: ("columns", 1), 3: ("rows", -1), 4: ("columns", -1)}
"""How an image is read out and which way, by the data set's number of the direction; others take all at once."""
LENS = tuple(f"[CameraCalibrationComponent].intrinsic.{k}" for k in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3"))
BOX = tuple(f"[LiDARBoxComponent].box.{k}" for k in ("center.x", "center.y", "center.z", "size.x", "size.y", "size.z", "heading"))

SAME = 1e-6
"""Metres, and sines, by which two poses may differ that are one."""

AROUND_US, STEP_US = (-50_000, 150_000), 5_000
"""The time around a frame's stamp in which its lidar column by column took its points, and by which steps the car's path is looked at."""

DRIVING = 1.0
"""Metres a second from which on the path tells when a column was taken; a standing car's columns count as taken at the frame's pose."""


def is_waymo(path: Path) -> bool:
    """Whether a path is a folder of segments, or one of its segments (which are no folders)."""
    return any((root / "camera_image").is_dir() and (root / "vehicle_pose").is_dir() for root in (path, path.parent))


def read_waymo(path: Path) -> Log:
    """The segment that `path` names. FileNotFoundError and ValueError name what is missing: segment, component or column."""
    root, name = (path, None) if (path / "vehicle_pose").is_dir() else (path.parent, path.name.removesuffix(".parquet"))
    segment = _segment(root, name)

    def component(kind: str) -> Path:
        return root / kind / f"{segment}.parquet"

    table = read_table(component("vehicle_pose"), (WHEN, BODY))
    order = np.argsort(table[WHEN])
    times = table[WHEN][order].astype(np.int64)
    if not len(times):
        raise ValueError(f"{component('vehicle_pose')} has no row; fetch it again")
    bodies = torch.stack([_matrix(table[BODY][i], component("vehicle_pose")) for i in order])
    origin = bodies[0, :3, 3].clone()
    home = translation(*(-origin).tolist())
    taken = read_table(component("camera_image"), TAKEN, others=False)  # without the pictures themselves
    moments = _moments(times, bodies, taken, component("camera_image"))
    ego = lengthened(moments, home @ bodies)
    cameras = _cameras(component, home, ego, taken)
    meta: dict = {
        "name": f"waymo-{segment}", "source": f"Waymo Open Dataset segment {segment}", "licence": "Waymo Dataset License Agreement",
        "attribution": "Waymo Open Dataset by Waymo", "body": "vehicle frame, x forward, y left, z up", "world_origin": origin.tolist(),
    }  # fmt: skip
    late = dict(zip(times.tolist(), moments.tolist(), strict=True))
    parts = {kind: Rows(component(kind), WHEN, columns) for kind, columns in SWEPT.items()}
    sweeps = tuple(Sweep(i, t, partial(_points, component, parts, t, late.get(t, t), home, ego)) for i, t in enumerate(_swept(component)))
    tracks = _tracks(component("lidar_box"), ego, times, home @ bodies)
    front = tuple(n for n in FRONT if n in cameras)
    return Log(meta["name"], path, cameras, sweeps, tracks, ego, meta, front, lidars=_mounts(component) if sweeps else {})


def _segment(root: Path, name: str | None) -> str:
    known = sorted(p.stem for p in (root / "vehicle_pose").glob("*.parquet"))
    if name is None and len(known) == 1:
        return known[0]
    if name is None:
        some = ", ".join(known[:4]) or "none"
        raise ValueError(f"{root} holds {len(known)} segments ({some}); name one, as {root / (known[0] if known else '<segment>')}")
    if name not in known:
        raise ValueError(unknown("segment", name, str(root), known))
    return name


def _matrix(values, path: Path) -> torch.Tensor:
    flat = np.asarray(values, dtype=np.float64).ravel()
    if len(flat) != 16:
        raise ValueError(f"{path} holds a pose of {len(flat)} numbers; 16 make one")
    return rigid(torch.from_numpy(flat.reshape(4, 4).copy()), str(path))


def _moments(times: np.ndarray, bodies: torch.Tensor, taken: dict[str, np.ndarray], images: Path) -> np.ndarray:
    """When the car stood at the frames' poses `[F, 4, 4]`, int64 us `[F]`: when the picture was taken that has the same pose, the front one
    if several do; frames without one are as late after their stamps `[F]` as others are."""
    late = np.full(len(times), np.nan)
    for i in np.argsort(-taken["key.camera_name"], kind="stable"):
        frame = int(np.searchsorted(times, taken[WHEN][i]).clip(max=len(times) - 1))
        if float((_matrix(taken[POSE][i], images) - bodies[frame]).abs().max()) < SAME:
            late[frame] = taken[STAMP][i] * 1e6 - times[frame]
    known = np.isfinite(late)
    usual = np.median(late[known]) if known.any() else 0.0
    return times + np.round(np.where(known, late, usual)).astype(np.int64)


def _cameras(component, home: torch.Tensor, ego: Trajectory, taken: dict[str, np.ndarray]) -> dict[str, LogCamera]:
    where, mount = component("camera_calibration"), "[CameraCalibrationComponent].extrinsic.transform"
    width, height = (f"[CameraCalibrationComponent].{k}" for k in ("width", "height"))
    direction = "[CameraCalibrationComponent].rolling_shutter_direction"
    table = read_table(where, ("key.camera_name", mount, width, height, direction, *LENS))
    images = component("camera_image")
    exposure, began, ended = READ
    cameras = {}
    for row, number in enumerate(table["key.camera_name"].tolist()):
        mine = np.flatnonzero(taken["key.camera_name"] == number)
        mine = mine[np.argsort(taken[WHEN][mine])]
        if not len(mine):
            continue
        stamps, middles = (np.round(t[mine] * 1e6).astype(np.int64) for t in (taken[STAMP], (taken[began] + taken[ended]) / 2))
        shutter, way = SHUTTERS.get(int(table[direction][row]), ("global", 0))
        # a row is exposed for a while: from the middle of the first's exposure to that of the last's
        readout = way * round(float(np.median((taken[ended] - taken[began] - taken[exposure])[mine])) * 1e6)
        name = CAMERAS.get(int(number), f"camera_{number}")
        with stating(f"{where}, camera {number}"):
            lens = OpenCV(*(float(table[k][row]) for k in LENS))
        body_from_cam = _matrix(table[mount][row], where) @ inverse(CAM_FROM_FLU)
        bodies = home @ torch.stack([_matrix(taken[POSE][i], images) for i in mine])
        moved = inverse(ego.near_each(torch.from_numpy(stamps))) @ ego.near_each(torch.from_numpy(middles))
        poses = bodies @ moved @ body_from_cam
        files = tuple(Packed(f"{images}, {name} at {taken[WHEN][i]}", partial(read_cell, images, IMAGE, int(i))) for i in mine)
        size = int(table[width][row]), int(table[height][row])
        cameras[name] = LogCamera(name, lens, *size, files, torch.from_numpy(middles), poses, shutter, readout)
    if not cameras:
        raise ValueError(f"{images} has no picture of the cameras of {where}")
    return dict(sorted(cameras.items(), key=lambda item: (item[0] not in FRONT, item[0])))


def _swept(component) -> list[int]:
    """The sweeps' stamps; none where the lidar was not fetched."""
    if not component("lidar").is_file():
        return []
    for kind in ("lidar_calibration", "lidar_pose"):
        if not component(kind).is_file():
            raise FileNotFoundError(f"{component(kind)} is missing; lidar/ cannot be read without it: fetch it too")
    return [int(t) for t in np.unique(read_table(component("lidar"), (WHEN,), others=False)[WHEN])]


def _mounts(component) -> dict[int, np.ndarray]:
    """Where the lidars stand in the vehicle."""
    matrices = "[LiDARCalibrationComponent].extrinsic.transform"
    table = read_table(component("lidar_calibration"), ("key.laser_name", matrices))
    pairs = zip(table["key.laser_name"].tolist(), table[matrices], strict=True)
    return {int(laser): _matrix(m, component("lidar_calibration"))[:3, 3].numpy() for laser, m in pairs}


def _passed(places: np.ndarray, ego: Trajectory, stamp: int, otherwise: int) -> np.ndarray:
    """When the body passed by places `[N, 3]` of its path around a stamp, int64 us `[N]`; `otherwise` where it hardly moves."""
    times = stamp + np.arange(*AROUND_US, STEP_US)
    path = ego.near_each(torch.from_numpy(times))[:, :3, 3].numpy()
    ahead = path[-1] - path[0]
    length = float(np.linalg.norm(ahead))
    if length < DRIVING * (times[-1] - times[0]) / 1e6:
        return np.full(len(places), otherwise)
    along = np.maximum.accumulate((path - path[0]) @ ahead / length)
    return np.round(np.interp((places - path[0]) @ ahead / length, along, times - stamp)).astype(np.int64) + stamp


def _points(component, parts: dict[str, Rows], stamp: int, moment: int, home: torch.Tensor, ego: Trajectory) -> LidarPoints:
    """First returns of all lidars at a stamp, in the world; those without a pose a pixel count as taken at the `moment` of the frame's."""
    table, turning, vehicle = (parts[kind].read(stamp) for kind in SWEPT)
    if not len(vehicle[BODY]):
        raise ValueError(f"{component('vehicle_pose')} has no pose at {stamp}, of which lidar/ has a sweep; fetch it again")
    body = _matrix(vehicle[BODY][0], component("vehicle_pose"))
    prefix = "[LiDARCalibrationComponent]."
    calibration = read_table(
        component("lidar_calibration"),
        ("key.laser_name", f"{prefix}extrinsic.transform", *(f"{prefix}beam_inclination.{k}" for k in ("min", "max"))),
    )
    xyz, times, sensor = [], [], []
    for row, laser in enumerate(table["key.laser_name"].tolist()):
        at = int(np.flatnonzero(calibration["key.laser_name"] == laser)[0])
        image = _image(table[f"{RANGES}.values"][row], table[f"{RANGES}.shape"][row], component("lidar"))
        mount = _matrix(calibration[f"{prefix}extrinsic.transform"][at], component("lidar_calibration"))
        beams = calibration.get(f"{prefix}beam_inclination.values")
        limits = [float(calibration[f"{prefix}beam_inclination.{k}"][at]) for k in ("min", "max")]
        local, hit = _from_range(image[..., 0], mount.numpy(), None if beams is None else beams[at], limits)
        placed = local @ mount[:3, :3].numpy().T + mount[:3, 3].numpy()
        own = np.flatnonzero(turning["key.laser_name"] == laser)
        if len(own):
            pixels = _image(turning[f"{PIXELS}.values"][own[0]], turning[f"{PIXELS}.shape"][own[0]], component("lidar_pose"))
            pixel = pixels[hit].astype(np.float64)
            placed = np.einsum("nij,nj->ni", _rotations(pixel[:, :3]), placed) + pixel[:, 3:]
            times.append(_passed(pixel[:, 3:] + home[:3, 3].numpy(), ego, stamp, moment))
        else:
            placed = placed @ body[:3, :3].numpy().T + body[:3, 3].numpy()
            times.append(np.full(len(placed), moment))
        xyz.append(placed + home[:3, 3].numpy())
        sensor.append(np.full(len(placed), laser))
    if not xyz:
        return LidarPoints(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64))
    return LidarPoints(np.concatenate(xyz), np.concatenate(times), np.concatenate(sensor))


def _image(values, shape, path: Path) -> np.ndarray:
    flat, size = np.asarray(values, dtype=np.float32), tuple(int(n) for n in shape)
    if len(size) != 3 or flat.size != np.prod(size):
        raise ValueError(f"{path} holds a range image of {flat.size} numbers for the shape {size}; fetch it again")
    return flat.reshape(size)


def _from_range(ranges: np.ndarray, mount: np.ndarray, beams, limits: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Points `[N, 3]` in the lidar's frame of a range image `[H, W]`, and the mask of pixels that have one.

    Rows run from the highest beam down, columns from behind over the left to behind again, less the lidar's own heading
    (waymo_open_dataset/utils/range_image_utils.py).
    """
    height, width = ranges.shape
    if beams is None or np.size(beams) != height:
        beams = limits[0] + (np.arange(height) + 0.5) / height * (limits[1] - limits[0])
    inclination = np.asarray(beams, dtype=np.float64)[::-1, None]
    azimuth = (1 - 2 * (np.arange(width) + 0.5) / width) * np.pi - np.arctan2(mount[1, 0], mount[0, 0])
    hit = ranges > 0
    level = np.cos(inclination) * ranges
    xyz = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(inclination) * ranges + 0 * azimuth], -1)
    return xyz[hit], hit


def _rotations(angles: np.ndarray) -> np.ndarray:
    """Rz(yaw) Ry(pitch) Rx(roll) `[N, 3, 3]` of roll, pitch, yaw `[N, 3]` in radians."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles).T, np.sin(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(r, -1) for r in rows], -2)


def _tracks(path: Path, ego: Trajectory, stamps: np.ndarray, bodies: torch.Tensor) -> tuple:
    """Tracks of the boxes, which stand in the vehicle frame by their middles; signs are no objects that move.

    bodies: `world_from_body` `[F, 4, 4]` of the frames with these stamps `[F]`, whose boxes get their frame's stamp, as its sweep has."""
    if not path.is_file():
        return ()
    kind = "[LiDARBoxComponent].type"
    table = read_table(path, ("key.laser_object_id", WHEN, kind, *BOX))
    times = table[WHEN].astype(np.int64)
    rows = np.stack([table[k] for k in BOX], 1).astype(np.float64)
    frames = torch.from_numpy(np.searchsorted(stamps, times).clip(max=len(stamps) - 1))
    poses = bodies[frames] @ from_middles(upright(rows[:, :3], rows[:, 6]), rows[:, 5])
    found = []
    for name in dict.fromkeys(table["key.laser_object_id"].tolist()):
        mine = np.flatnonzero(table["key.laser_object_id"] == name)
        found.append(Boxes(str(name), LABELS.get(int(table[kind][mine[0]]), "object"), times[mine], poses[mine], rows[mine, 3:6]))
    return tracks_of(found, ego, str(path))
