"""The made-up recording in KITTI's layouts: a raw drive, synced and rectified, and an odometry sequence."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import torch
from made_tape import BODY_FROM_LIDAR, FRAMES, MOVER, PARKED, STAMPS, STEP_US, Tape
from PIL import Image

from scenes.poses import inverse, translation, yaw, yaw_of

EARTH = 6378137.0
LATITUDE = 49.0
NAMES = {"front": "02", "right": "03"}
TILT = yaw(0.01)
"""Of the reference camera against the lidar, beside the change of axes."""


def _text(values) -> str:
    return " ".join(f"{v:.15e}" for v in np.asarray(values).ravel().tolist())


def _stamps(path: Path, times) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"{datetime.fromtimestamp(int(t) // 1_000_000, UTC):%Y-%m-%d %H:%M:%S}.{int(t) % 1_000_000:06d}000" for t in times]
    path.write_text("\n".join(lines) + "\n")


def _projections(tape: Tape) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """`rect_from_body` of the reference camera, 0.06 m left of the front one, and 3x4 projections by camera number."""
    rect_from_body = inverse(tape.cameras["front"] @ translation(-0.06, 0.0, 0.0))
    lens = tape.street.rig["front_camera"].lens
    k = torch.tensor([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]], dtype=torch.float64)
    made = {}
    for name, number in NAMES.items():
        made[number] = k @ (inverse(tape.cameras[name]) @ inverse(rect_from_body))[:3]
    return rect_from_body, made


def _scan(path: Path, xyz: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.concatenate([xyz, np.zeros((len(xyz), 1))], 1).astype("<f4").tofile(path)


def write_kitti_raw(folder: Path, tape: Tape) -> Path:
    """A `_sync` drive and the calibration beside it; the third sweep is lost."""
    drive = folder / "2011_09_26" / "2011_09_26_drive_0001_sync"
    rect_from_body, projections = _projections(tape)
    lidar_from_imu = inverse(BODY_FROM_LIDAR)
    turned = TILT[:3, :3]  # R_rect_00 takes back what the unrectified camera is turned by
    cam_from_lidar = torch.eye(4, dtype=torch.float64)
    cam_from_lidar[:3] = (torch.block_diag(turned.T, torch.eye(1)).double() @ rect_from_body @ BODY_FROM_LIDAR)[:3]
    lines = ["calib_time: 09-Jan-2012 13:57:47", f"R_rect_00: {_text(turned)}"]
    lines += [f"P_rect_{number}: {_text(p)}" for number, p in projections.items()]
    drive.mkdir(parents=True)
    (drive.parent / "calib_cam_to_cam.txt").write_text("\n".join(lines) + "\n")
    for name, pose in (("velo_to_cam", cam_from_lidar), ("imu_to_velo", lidar_from_imu)):
        text = f"calib_time: 25-May-2012 16:47:16\nR: {_text(pose[:3, :3])}\nT: {_text(pose[:3, 3])}\n"
        (drive.parent / f"calib_{name}.txt").write_text(text)

    for part in ("oxts", "image_02", "image_03", "velodyne_points"):
        _stamps(drive / part / "timestamps.txt", STAMPS)
        (drive / part / "data").mkdir()
    scale = np.cos(np.radians(LATITUDE)) * EARTH
    base = scale * np.log(np.tan(np.radians(90 + LATITUDE) / 2))
    start = tape.ego.at(int(STAMPS[0]))[:3, 3]
    for i, t in enumerate(STAMPS.tolist()):
        body = tape.ego.at(t)
        x, y, z = (body[:3, 3] - start).tolist()
        lat = np.degrees(2 * np.arctan(np.exp((y + base) / scale))) - 90
        packet = [lat, np.degrees((x + 2000) / scale), z + 116.0, 0.0, 0.0, float(yaw_of(body)), *np.zeros(24)]
        (drive / "oxts" / "data" / f"{i:010d}.txt").write_text(_text(packet) + "\n")
        for name, number in NAMES.items():
            Image.fromarray(tape.image(name, t)).save(drive / f"image_{number}" / "data" / f"{i:010d}.png")
        if i != 2:
            _scan(drive / "velodyne_points" / "data" / f"{i:010d}.bin", tape.scan(t, STEP_US))
    boxes = ((MOVER, [tape.mover(t) for t in STAMPS.tolist()]), (PARKED, [tape.parked()] * FRAMES))
    items = [_tracklet("Car", size, poses, tape) for size, poses in boxes]
    head = '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
    body = "".join(items)
    xml = f'<boost_serialization signature="serialization::archive" version="9"><tracklets class_id="0"><count>2</count>{body}</tracklets>'
    (drive / "tracklet_labels.xml").write_text(head + xml + "</boost_serialization>\n")
    return drive


def _tracklet(label: str, size: np.ndarray, poses: list, tape: Tape) -> str:
    rows = []
    for t, pose in zip(STAMPS.tolist(), poses, strict=True):
        looked = float(t)
        for _ in range(4):  # where the lidar was depends on when it looked there
            local = inverse(tape.ego.near(round(looked)) @ BODY_FROM_LIDAR) @ pose
            looked = t + STEP_US * float(torch.atan2(local[1, 3], local[0, 3])) / (2 * np.pi)
        x, y, z = local[:3, 3].tolist()
        rows.append(f"<item><tx>{x}</tx><ty>{y}</ty><tz>{z}</tz><rx>0</rx><ry>0</ry><rz>{float(yaw_of(local))}</rz><state>2</state></item>")
    length, width, height = size.tolist()
    about = f"<objectType>{label}</objectType><h>{height}</h><w>{width}</w><l>{length}</l><first_frame>0</first_frame>"
    return f"<item>{about}<poses><count>{len(rows)}</count>{''.join(rows)}</poses><finished>1</finished></item>"


def write_kitti_odometry(folder: Path, tape: Tape) -> Path:
    """Sequence 04 and its poses; the third sweep is lost."""
    sequence = folder / "dataset" / "sequences" / "04"
    (folder / "dataset" / "poses").mkdir(parents=True)
    rect_from_body, projections = _projections(tape)
    lines = [f"P{int(number)}: {_text(p)}" for number, p in projections.items()]
    sequence.mkdir(parents=True)
    (sequence / "calib.txt").write_text("\n".join([*lines, f"Tr: {_text((rect_from_body @ BODY_FROM_LIDAR)[:3])}"]) + "\n")
    (sequence / "times.txt").write_text("".join(f"{(t - STAMPS[0]) / 1e6:e}\n" for t in STAMPS))
    first = tape.ego.at(int(STAMPS[0])) @ inverse(rect_from_body)
    poses = [(inverse(first) @ tape.ego.at(t) @ inverse(rect_from_body))[:3] for t in STAMPS.tolist()]
    (folder / "dataset" / "poses" / "04.txt").write_text("\n".join(_text(p) for p in poses) + "\n")
    for i, t in enumerate(STAMPS.tolist()):
        for name, number in NAMES.items():
            path = sequence / f"image_{int(number)}" / f"{i:06d}.png"
            path.parent.mkdir(exist_ok=True)
            Image.fromarray(tape.image(name, t)).save(path)
        if i != 2:
            _scan(sequence / "velodyne" / f"{i:06d}.bin", tape.scan(t))
    return sequence
