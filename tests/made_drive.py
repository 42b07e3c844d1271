"""The made-up street as a recorded drive in PandaSet's layout: images read out row by row, sampled sweeps, pickled cuboids."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from PIL import Image
from street import START_US, STEP_US

from recon.readers.pandaset import LIDAR_FROM_BODY, MIDDLE_US, READOUT_US
from render import render_frame
from scenes.poses import inverse, quat_from_matrix, yaw_of

ABSENT = 3
"""The sweep that is missing."""

SCANNED_US = -40_000
"""When the lidar passes over the mover, against the sweep's stamp."""


def write_drive(folder: Path, street, width=96, height=54) -> Path:
    """Write the street to `folder` and return it. The mover has two sibling tracks; a parked car's box stands beside the road."""
    generator = np.random.default_rng(0)
    frames = 8
    stamps = START_US + STEP_US * np.arange(frames)
    for name in street.rig:
        camera_folder = folder / "camera" / name
        camera_folder.mkdir(parents=True)
        times = [t - MIDDLE_US for t in street.frame_times(name).tolist()]
        rolling = replace(street.rig[name], shutter="rows", readout_us=READOUT_US).resized(width, height)
        poses = []
        for i, t in enumerate(times):
            camera = rolling.along(street.ego, t + MIDDLE_US - READOUT_US // 2)
            with torch.no_grad():
                rgb = render_frame(street, camera).rgb
            Image.fromarray((rgb.clamp(0, 1) * 255).round().byte().numpy()).save(camera_folder / f"{i:02d}.jpg", quality=95)
            poses.append(_pose(street.camera(name, t).world_from_cam))
        lens = camera.lens
        _write(camera_folder / "intrinsics.json", {"fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy})
        _write(camera_folder / "poses.json", poses)
        _write(camera_folder / "timestamps.json", [t / 1e6 for t in times])

    lidar = folder / "lidar"
    lidar.mkdir()
    bodies = [street.ego.at(int(t)) for t in stamps]
    _write(lidar / "poses.json", [_pose(b @ inverse(LIDAR_FROM_BODY)) for b in bodies])
    _write(lidar / "timestamps.json", [t / 1e6 for t in stamps.tolist()])
    mover = street.actors[0]
    cuboids = folder / "annotations" / "cuboids"
    cuboids.mkdir(parents=True)
    for i, stamp in enumerate(stamps.tolist()):
        scanned = stamp + SCANNED_US
        pose = mover.trajectory.at(scanned)
        if i != ABSENT:
            _sweep(lidar / f"{i:02d}.pkl.gz", street, mover, pose, stamp, scanned, generator)
        rows = [_cuboid("mover-a", "mover-b", 0, pose, mover.asset.size.numpy(), False)]
        if i < 5:
            rows.append(_cuboid("mover-b", "mover-a", 1, pose, mover.asset.size.numpy(), False))
        rows.append(_cuboid("parked", "-", -1, bodies[0] @ _at(14.0, -4.0), np.array([4.0, 1.8, 1.5]), True))
        pickle_frame(rows, cuboids / f"{i:02d}.pkl.gz")
    (folder / "meta").mkdir()
    _write(folder / "meta" / "gps.json", [{"lat": 37.7, "long": -122.4, "height": 2.0, "xvel": 0.0, "yvel": 0.0}] * frames)
    return folder


def pickle_frame(rows, path: Path) -> None:
    """Pickle a table as the official files are: text as objects, also where pyarrow is installed and pandas would use its strings."""
    with pd.option_context("future.infer_string", False):
        pd.DataFrame(rows).to_pickle(path)


def _write(path: Path, value) -> None:
    path.write_text(json.dumps(value))


def _pose(world_from: torch.Tensor) -> dict:
    heading = quat_from_matrix(world_from[:3, :3]).tolist()
    return {"position": dict(zip("xyz", world_from[:3, 3].tolist(), strict=True)), "heading": dict(zip("wxyz", heading, strict=True))}


def _at(x: float, y: float) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:2, 3] = torch.tensor([x, y])
    return pose


def _sweep(path: Path, street, mover, pose, stamp: int, scanned: int, generator) -> None:
    static = street.background.gaussians.means.double().numpy()
    static = static[generator.random(len(static)) < 0.5]
    own = mover.asset.gaussians.means.double().numpy() @ pose[:3, :3].numpy().T + pose[:3, 3].numpy()
    xyz = np.concatenate([static, own])
    xyz = xyz + generator.normal(0, 0.01, xyz.shape)
    xyz[: len(static), :2] += generator.uniform(-0.25, 0.25, (len(static), 2))  # a lidar does not hit the same spot again
    times = np.concatenate([np.full(len(static), stamp - 20_000), np.full(len(own), scanned)]) / 1e6
    columns = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], "i": np.zeros(len(xyz)), "t": times, "d": np.zeros(len(xyz), np.int64)}
    pickle_frame(columns, path)


def _cuboid(uuid: str, sibling: str, sensor: int, pose: torch.Tensor, size: np.ndarray, still: bool) -> dict:
    x, y, z = pose[:3, 3].tolist()
    return {
        "uuid": uuid, "label": "Car", "yaw": float(yaw_of(pose)) - np.pi / 2, "stationary": still, "camera_used": 0,
        "position.x": x, "position.y": y, "position.z": z + size[2] / 2,
        "dimensions.x": size[1], "dimensions.y": size[0], "dimensions.z": size[2],
        "cuboids.sibling_id": sibling, "cuboids.sensor_id": sensor,
    }  # fmt: skip
