"""A log in the layout of KITTI's raw drives, synced and rectified."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import torch

from recon.log import Log, Track
from recon.readers.kitti_files import scan_times
from recon.readers.kitti_raw import EARTH
from scenes.poses import inverse, translation, yaw, yaw_of
from tests.layouts import carried, ending, mount, picture, stamps

DRIVE = "2011_09_26/2011_09_26_drive_0001_sync"
LATITUDE = 49.0
NAMES = {"front": "02", "right": "03"}
TILT = yaw(0.01)
"""Of the reference camera against the lidar, beside the change of axes."""


def text(values) -> str:
    """Numbers as KITTI's files have them."""
    return " ".join(f"{v:.15e}" for v in np.asarray(values).ravel().tolist())


def projections(log: Log) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """`rect_from_body` of the reference camera, 0.06 m left of the front one, and 3x4 projections by camera number."""
    rect_from_body = inverse(mount(log, "front") @ translation(-0.06, 0.0, 0.0))
    made = {}
    for name, camera in log.cameras.items():
        lens = camera.lens
        k = torch.tensor([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]], dtype=torch.float64)
        made[NAMES[name]] = k @ (inverse(mount(log, name)) @ inverse(rect_from_body))[:3]
    return rect_from_body, made


def write_scan(path: Path, xyz: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.concatenate([xyz, np.zeros((len(xyz), 1))], 1).astype("<f4").tofile(path)


def write(folder: Path, log: Log, body_from_lidar: torch.Tensor) -> Path:
    """A `_sync` drive, and the calibration beside it. Each camera has a picture for every stamp of a sweep or box; points stand where the
    turning lidar saw them, which looks ahead at its stamps."""
    drive = folder / DRIVE
    rect_from_body, made = projections(log)
    turned = TILT[:3, :3]  # R_rect_00 takes back what the unrectified camera is turned by
    cam_from_lidar = torch.eye(4, dtype=torch.float64)
    cam_from_lidar[:3] = (torch.block_diag(turned.T, torch.eye(1)).double() @ rect_from_body @ body_from_lidar)[:3]
    lines = ["calib_time: 09-Jan-2012 13:57:47", f"R_rect_00: {text(turned)}", *(f"P_rect_{n}: {text(p)}" for n, p in made.items())]
    drive.mkdir(parents=True)
    (drive.parent / "calib_cam_to_cam.txt").write_text("\n".join(lines) + "\n")
    for name, pose in (("velo_to_cam", cam_from_lidar), ("imu_to_velo", inverse(body_from_lidar))):
        rows = f"calib_time: 25-May-2012 16:47:16\nR: {text(pose[:3, :3])}\nT: {text(pose[:3, 3])}\n"
        (drive.parent / f"calib_{name}.txt").write_text(rows)

    frames = stamps(log)
    for part in ("oxts", "velodyne_points"):
        _write_stamps(drive / part / "timestamps.txt", frames)
        (drive / part / "data").mkdir()
    for i, packet in enumerate(_packets(log, frames)):
        (drive / "oxts" / "data" / f"{i:010d}.txt").write_text(text(packet) + "\n")
    for name, camera in log.cameras.items():
        there = drive / f"image_{NAMES[name]}"
        _write_stamps(there / "timestamps.txt", camera.times_us.tolist())
        (there / "data").mkdir()
        for i in range(len(camera)):
            (there / "data" / f"{i:010d}{ending(camera)}").write_bytes(picture(camera, i))
    for sweep in log.sweeps:
        points = sweep.read()
        moments, which = np.unique(points.times_us, return_inverse=True)
        local = carried(points.xyz, inverse(log.ego.near_each(torch.from_numpy(moments)) @ body_from_lidar)[which])
        write_scan(drive / "velodyne_points" / "data" / f"{frames.index(sweep.time_us):010d}.bin", local)
    items = [item for track in log.tracks for item in _tracklets(track, log, frames, body_from_lidar)]
    head = '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
    body = f"<count>{len(items)}</count>{''.join(items)}"
    xml = f'<boost_serialization signature="serialization::archive" version="9"><tracklets class_id="0">{body}</tracklets>'
    (drive / "tracklet_labels.xml").write_text(head + xml + "</boost_serialization>\n")
    return drive


def _write_stamps(path: Path, times) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"{datetime.fromtimestamp(int(t) // 1_000_000, UTC):%Y-%m-%d %H:%M:%S}.{int(t) % 1_000_000:06d}000" for t in times]
    path.write_text("\n".join(lines) + "\n")


def _packets(log: Log, frames: list[int]) -> list[list[float]]:
    """latitude, longitude, height, roll, pitch, yaw and what nobody reads, a frame."""
    scale = np.cos(np.radians(LATITUDE)) * EARTH
    base = scale * np.log(np.tan(np.radians(90 + LATITUDE) / 2))
    bodies = log.ego.near_each(torch.tensor(frames))
    start, packets = bodies[0, :3, 3].clone(), []
    for body in bodies:
        x, y, z = (body[:3, 3] - start).tolist()
        lat = np.degrees(2 * np.arctan(np.exp((y + base) / scale))) - 90
        roll, pitch = float(torch.atan2(body[2, 1], body[2, 2])), -float(torch.asin(body[2, 0]))
        packets.append([lat, np.degrees((x + 2000) / scale), z + 116.0, roll, pitch, float(yaw_of(body)), *np.zeros(24)])
    return packets


def _tracklets(track: Track, log: Log, frames: list[int], body_from_lidar: torch.Tensor) -> list[str]:
    """A track's tracklets: one for each run of frames in which it has boxes."""
    numbers = np.searchsorted(frames, track.times_us)
    turn_us = int(np.median(np.diff(frames)))
    runs = np.split(np.arange(len(numbers)), np.flatnonzero(np.diff(numbers) > 1) + 1)
    return [_tracklet(track, run, int(numbers[run[0]]), log, turn_us, body_from_lidar) for run in runs]


def _tracklet(track: Track, run: np.ndarray, first: int, log: Log, turn_us: int, body_from_lidar: torch.Tensor) -> str:
    rows = []
    for t, pose in zip(track.times_us[run].tolist(), track.world_from_box[torch.from_numpy(run)], strict=True):
        looked = t
        for _ in range(4):  # where the lidar was depends on when it looked there
            local = inverse(log.ego.near(looked) @ body_from_lidar) @ pose
            looked = int(scan_times(local[None, :3, 3].numpy(), t, turn_us)[0])
        x, y, z = local[:3, 3].tolist()
        rows.append(f"<item><tx>{x}</tx><ty>{y}</ty><tz>{z}</tz><rx>0</rx><ry>0</ry><rz>{float(yaw_of(local))}</rz><state>2</state></item>")
    length, width, height = track.size.tolist()
    about = (
        f"<objectType>{track.label.capitalize()}</objectType><h>{height}</h><w>{width}</w><l>{length}</l><first_frame>{first}</first_frame>"
    )
    return f"<item>{about}<poses><count>{len(rows)}</count>{''.join(rows)}</poses><finished>1</finished></item>"
