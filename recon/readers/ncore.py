"""Reads a sequence of NVIDIA NCore, version 4, through the package nvidia-ncore (19.7), the only module that imports it.

`ncore/<sequence>.json`, the sequence's file that names its component stores, or the folder that holds it. The body is the rig frame, x
forward, y left, z up; the world is the pose graph's "world" less the body's place at the start. Frames have a first and a last moment,
between which rolling shutters read rows or columns and lidars turn; points come free of that motion.
"""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path

import numpy as np
import torch

from recon.log import LidarPoints, Log, LogCamera, Packed, Sweep, Track, lengthened
from recon.objects.tracks import Boxes, from_middles, slug, tracks_of
from recon.readers.stated import rigid, stating
from scenes.lenses import Fisheye, FTheta, Lens, OpenCV, Pinhole
from scenes.poses import inverse, translation
from scenes.trajectory import Trajectory

KEYS = ("sequence_id", "sequence_timestamp_interval_us", "component_stores")
FIX = "NCore's sequences are read by nvidia-ncore, which is not installed; get it with: pip install nvidia-ncore"
SHUTTERS = {
    "ROLLING_TOP_TO_BOTTOM": ("rows", 1), "ROLLING_LEFT_TO_RIGHT": ("columns", 1),
    "ROLLING_BOTTOM_TO_TOP": ("rows", -1), "ROLLING_RIGHT_TO_LEFT": ("columns", -1),
}  # fmt: skip
LABELS = {
    "automobile": "car", "heavy_truck": "truck", "person": "pedestrian", "rider": "cyclist", "other_vehicle": "vehicle",
    "protruding_object": "object",
}  # fmt: skip


def is_ncore(path: Path) -> bool:
    """Whether a path is a sequence's file, or a folder that holds one."""
    return _meta_file(path) is not None


def _meta_file(path: Path) -> Path | None:
    candidates = [path] if path.suffix == ".json" else sorted(path.glob("*.json")) if path.is_dir() else []
    return next((file for file in candidates if _is_meta(file)), None)


def _is_meta(file: Path) -> bool:
    try:
        with open(file, "rb") as opened:
            head = opened.read(1 << 16)
        return b"component_stores" in head and all(key in json.loads(file.read_bytes()) for key in KEYS)
    except (OSError, ValueError):
        return False


def read_ncore(path: Path) -> Log:
    """The sequence at `path`. ValueError where the package is not installed, a store is missing or corrupt, or there is no camera."""
    file = _meta_file(path)
    assert file is not None, "is_ncore says so"
    loader = _loader(file)
    if not loader.camera_ids:
        raise ValueError(f"{file} has no camera; add the component store that holds its cameras")
    sensors = {name: loader.get_camera_sensor(name) for name in loader.camera_ids}
    lidars = {name: loader.get_lidar_sensor(name) for name in loader.lidar_ids}
    stamps = [np.asarray(s.frames_timestamps_us, dtype=np.int64).ravel() for s in (*lidars.values(), *sensors.values())]
    # lidars may begin after cameras do, and turn more rarely than these take pictures
    middles = [stamp.reshape(-1, 2).sum(1) // 2 for stamp in stamps[len(lidars) :]]
    times = np.unique(np.concatenate([stamps[0], *middles]))
    bodies = _poses(loader, "rig", times, file)
    origin = bodies[0, :3, 3].clone()
    home = translation(*(-origin).tolist())
    ego = lengthened(times, home @ bodies)
    cameras = {name: _camera(loader, name, sensor, home, file) for name, sensor in sorted(sensors.items(), key=lambda s: _rank(s[0]))}
    frames = sorted((int(t), name, i) for name, lidar in lidars.items() for i, (_, t) in enumerate(lidar.frames_timestamps_us.tolist()))
    numbers = {name: k for k, name in enumerate(lidars)}
    sweeps = tuple(
        Sweep(k, t, partial(_points, loader, lidars[name], i, numbers[name], home, file)) for k, (t, name, i) in enumerate(frames)
    )
    tracks = _tracks(loader, home, ego, file)
    about = loader.generic_meta_data
    meta: dict = {
        "name": f"ncore-{loader.sequence_id}", "source": f"NCore sequence {loader.sequence_id}",
        "licence": str(about.get("license", about.get("licence", "as the sequence's publisher says"))),
        "body": "rig frame, x forward, y left, z up", "world_origin": origin.tolist(),
    }  # fmt: skip
    mounts = {k: inverse(bodies[0]) @ _poses(loader, name, times[:1], file)[0] for name, k in numbers.items()}
    front = tuple(n for n in cameras if _rank(n)[0] < 2)
    return Log(meta["name"], path, cameras, sweeps, tracks, ego, meta, front, lidars={k: m[:3, 3].numpy() for k, m in mounts.items()})


def _rank(name: str) -> tuple[int, str]:
    """The front camera first, then those beside it that also look ahead, then all others."""
    ahead = "front" in name.lower()
    return (0 if ahead and not any(side in name.lower() for side in ("left", "right", "cross", "tele")) else 1 if ahead else 2, name)


def _loader(file: Path):
    try:
        from ncore.data.v4 import CuboidsComponent, MasksComponent, SequenceComponentGroupsReader, SequenceLoaderV4
    except ModuleNotFoundError:
        raise ValueError(f"{file}: {FIX}") from None
    try:
        stores = SequenceComponentGroupsReader([file])
        # the loader insists on masks and cuboids, which a sequence need not have, unless it is told that there are none
        masks, cuboids = (bool(stores.open_component_readers(part.Reader)) for part in (MasksComponent, CuboidsComponent))
        named = {True: "default", False: None}
        return SequenceLoaderV4(stores, masks_component_group_name=named[masks], cuboids_component_group_name=named[cuboids])
    except (AssertionError, OSError, KeyError, ValueError) as problem:
        why = str(problem).splitlines()[0][:160] if str(problem) else type(problem).__name__
        raise ValueError(f"{file} does not open as an NCore sequence ({why}); fetch its component stores again") from None


def _poses(loader, node: str, times_us: np.ndarray, file: Path) -> torch.Tensor:
    """`world_from_node` float64 `[F, 4, 4]` at times; ValueError where the pose graph does not lead from it to the world."""
    try:
        found = loader.pose_graph.evaluate_poses(node, "world", np.asarray(times_us, dtype=np.uint64))
    except (KeyError, ValueError, AssertionError) as problem:
        raise ValueError(f"{file} has no poses of {node} in the world at the times of its frames ({problem})") from None
    return rigid(torch.from_numpy(np.array(found, dtype=np.float64)), f"{file}, poses of {node}")


def _camera(loader, name: str, sensor, home: torch.Tensor, file: Path) -> LogCamera:
    first, last = np.asarray(sensor.frames_timestamps_us, dtype=np.int64).T
    middles, model = (first + last) // 2, sensor.model_parameters
    shutter, way = SHUTTERS.get(model.shutter_type.name, ("global", 0))
    if model.external_distortion_parameters is not None:
        print(f"{file}: the windshield before {name} is left out, which bends its view by a few pixels", file=sys.stderr)
    files = tuple(Packed(f"{file}, frame {i} of {name}", partial(_picture, sensor, i)) for i in range(len(middles)))
    width, height = (int(n) for n in model.resolution)
    poses = home @ _poses(loader, name, middles, file)
    readout = way * round(float(np.median(last - first)))
    mask = sensor.get_mask_images().get("ego")
    ego = None if mask is None else np.asarray(mask.convert("L")) > 0
    with stating(f"{file}, {name}"):
        lens = lens_of(model, f"{file}, {name}")
    return LogCamera(name, lens, width, height, files, torch.from_numpy(middles), poses, shutter, readout, ego)


def _picture(sensor, index: int) -> bytes:
    return sensor.get_frame_data(index).get_encoded_image_data()


def lens_of(model, where: str) -> Lens:
    """Our lens for NCore's parameters: the same formulas. ValueError for lenses of other types."""
    kind = model.type()
    centre = [float(v) for v in model.principal_point]
    if kind == "ftheta":
        # f-theta's principal points count from the first pixel's centre, all others from its corner
        bend = [float(v) for v in model.angle_to_pixeldist_poly]
        return FTheta(centre[0] + 0.5, centre[1] + 0.5, *bend[1:6], *(float(v) for v in model.linear_cde))
    if kind not in ("ideal-pinhole", "opencv-pinhole", "opencv-fisheye"):
        raise ValueError(f"{where} has the lens {kind}; read are ftheta, ideal-pinhole, opencv-pinhole and opencv-fisheye")
    focal = [float(v) for v in model.focal_length]
    if kind == "ideal-pinhole":
        return Pinhole(*focal, *centre)
    radial = [float(v) for v in model.radial_coeffs]
    if kind == "opencv-fisheye":
        return Fisheye(*focal, *centre, *radial)
    tangential, prism = ([float(v) for v in values] for values in (model.tangential_coeffs, model.thin_prism_coeffs))
    if not any((*radial, *tangential, *prism)):
        return Pinhole(*focal, *centre)
    return OpenCV(*focal, *centre, *radial[:2], *tangential, *radial[2:], *prism)


def _points(loader, lidar, index: int, number: int, home: torch.Tensor, file: Path) -> LidarPoints:
    """First returns of one turn of a lidar, in the world."""
    cloud = lidar.get_frame_point_cloud(index, motion_compensation=True, with_start_points=False, return_index=0)
    valid = np.asarray(lidar.get_frame_ray_bundle_return_valid_mask(index, 0), dtype=bool)
    xyz, times = np.asarray(cloud.xyz_m_end, dtype=np.float64), np.asarray(lidar.get_frame_ray_bundle_timestamp_us(index), dtype=np.int64)
    valid &= np.isfinite(xyz).all(1)
    end = np.array([int(lidar.frames_timestamps_us[index, 1])])
    pose = (home @ _poses(loader, lidar.sensor_id, end, file)[0]).numpy()
    return LidarPoints(xyz[valid] @ pose[:3, :3].T + pose[:3, 3], times[valid], np.full(int(valid.sum()), number))


def _tracks(loader, home: torch.Tensor, ego: Trajectory, file: Path) -> tuple[Track, ...]:
    """Tracks of the cuboids, at the moments that they are of, which may lie within the frames that they were drawn in or between them."""
    from scipy.spatial.transform import Rotation

    seen: dict[str, dict[int, object]] = {}
    for o in loader.get_cuboid_track_observations():
        seen.setdefault(o.track_id, {}).setdefault(o.timestamp_us, o)
    found = []
    for track, by_time in seen.items():
        observations: list = [by_time[t] for t in sorted(by_time)]
        times = np.array(sorted(by_time), dtype=np.int64)
        drawn_in, drawn_at = (np.array([getattr(o, f"reference_frame_{of}") for o in observations]) for of in ("id", "timestamp_us"))
        frames = torch.zeros(len(times), 4, 4, dtype=torch.float64)
        for name in np.unique(drawn_in):
            frames[torch.from_numpy(drawn_in == name)] = _poses(loader, str(name), drawn_at[drawn_in == name], file)
        local = np.tile(np.eye(4), (len(times), 1, 1))
        local[:, :3, :3] = Rotation.from_euler("xyz", [o.bbox3.rot for o in observations]).as_matrix()
        local[:, :3, 3] = [o.bbox3.centroid for o in observations]
        sizes = np.array([o.bbox3.dim for o in observations], dtype=np.float64)
        label = slug(str(observations[0].class_id), LABELS)
        found.append(Boxes(track, label, times, home @ frames @ from_middles(torch.from_numpy(local), sizes[:, 2]), sizes))
    return tracks_of(found, ego, str(file))
