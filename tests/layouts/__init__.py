"""Writers of data sets' published layouts: each puts a log on disk as its data set would, for the readers' tests and `bench.layouts`.

A log as they take it: cameras called front and right are fixed to its car and have a picture or less a sweep; sweeps hold points of sensor
0, and 1 where there are two lidars; boxes have the stamps of sweeps. Pictures are copied as they are.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from recon.log import Log, LogCamera, mean_pose
from recon.objects.tracks import KINDS, VEHICLES


def picture(camera: LogCamera, index: int) -> bytes:
    """A frame's picture, as it is stored."""
    file = camera.files[index]
    return file.read_bytes() if isinstance(file, Path) else file.read()


def ending(camera: LogCamera) -> str:
    """That of its pictures' names."""
    return Path(str(camera.files[0])).suffix


def mount(log: Log, name: str) -> torch.Tensor:
    """`body_from_cam` of one of its cameras."""
    return mean_pose(log.offsets(name))


def stamps(log: Log) -> list[int]:
    """When there are sweeps or boxes, which are drawn in sweeps that may have been lost."""
    return sorted({s.time_us for s in log.sweeps} | {int(t) for track in log.tracks for t in track.times_us})


def carried(points: np.ndarray, poses: torch.Tensor) -> np.ndarray:
    """Points `[N, 3]` by one pose, or each by its own `[N, 4, 4]`."""
    moved = poses.numpy()
    if moved.ndim == 2:
        return points @ moved[:3, :3].T + moved[:3, 3]
    return np.einsum("nij,nj->ni", moved[:, :3, :3], points) + moved[:, :3, 3]


def middle_of(pose: torch.Tensor, size: np.ndarray) -> torch.Tensor:
    """The pose of a box at its middle, of that at its base."""
    up = torch.eye(4, dtype=torch.float64)
    up[2, 3] = size[2] / 2
    return pose @ up


def kind_of(label: str) -> str:
    """vehicle, pedestrian, cyclist or object: the classes that all data sets tell apart."""
    return "vehicle" if label in VEHICLES else {"ped": "pedestrian", "cyc": "cyclist"}.get(KINDS.get(label, ""), "object")
