"""A lidar that turns on a car, in a street of boxes of which some move: the sweeps it would have made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from recon.log import LidarPoints, Log, Sweep
from scenes.poses import translation
from scenes.trajectory import Trajectory

MOUNT = np.array([0.9, 0.0, 1.8])
TURN_US = 100_000
NOISE = 0.02


@dataclass(frozen=True)
class Box:
    """A box `[length, width, height]` on the ground; `at(seconds)` gives its middle's x and y and its yaw."""

    size: tuple[float, float, float]
    at: Callable[[float], tuple[float, float, float]]


def standing(x: float, y: float, size: tuple[float, float, float] = (4.4, 1.8, 1.5), yaw: float = 0.0) -> Box:
    return Box(size, lambda t: (x, y, yaw))


def drive(boxes: Sequence[Box], count: int = 40, speed: float = 8.0, rows: int = 32, columns: int = 720, seed: int = 0) -> Log:
    """A log of `count` sweeps, ten a second, by a car that goes along x; it has no boxes and no cameras."""
    times = np.arange(-1, count + 1) * TURN_US
    ego = Trajectory(torch.from_numpy(times), torch.stack([translation(speed * t / 1e6, 0.0, 0.0) for t in times]))
    noise = np.random.default_rng(seed)
    sweeps = tuple(_sweep(i, boxes, speed, rows, columns, noise) for i in range(count))
    return Log("street", Path("street"), {}, sweeps, (), ego, {}, lidars={0: MOUNT})


def _sweep(index: int, boxes: Sequence[Box], speed: float, rows: int, columns: int, noise: np.random.Generator) -> Sweep:
    stamp = index * TURN_US
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    times = stamp + np.round(azimuth / (2 * np.pi) * TURN_US).astype(np.int64)
    elevation = np.radians(np.linspace(-20, 8, rows))
    a, e = (x.ravel() for x in np.meshgrid(azimuth, elevation))
    towards = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1)
    when = np.tile(times, rows)
    eye = MOUNT + np.stack([speed * when / 1e6, 0 * when, 0 * when], 1)
    away = np.where(towards[:, 2] < 0, -eye[:, 2] / np.minimum(towards[:, 2], -1e-9), np.inf)
    for box in boxes:
        away = np.minimum(away, _struck(box, eye, towards, when / 1e6))
    hit = away < 90
    xyz = eye[hit] + towards[hit] * (away[hit] + noise.normal(0, NOISE, hit.sum()))[:, None]
    points = LidarPoints(xyz, when[hit], np.zeros(int(hit.sum()), np.int64))
    return Sweep(index, stamp, lambda: points)


def _struck(box: Box, eye: np.ndarray, towards: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """How far `[N]` rays go until they strike the box where it is at their moments; inf where they miss (slabs, Kay and Kajiya 1986)."""
    x, y, yaw = (np.array(v) for v in zip(*(box.at(t) for t in np.unique(seconds)), strict=True))
    which = np.searchsorted(np.unique(seconds), seconds)
    x, y, cos, sin = x[which], y[which], np.cos(yaw[which]), np.sin(yaw[which])

    def turned(dx: np.ndarray, dy: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.stack([cos * dx + sin * dy, -sin * dx + cos * dy, z], 1)

    from_box = turned(eye[:, 0] - x, eye[:, 1] - y, eye[:, 2] - box.size[2] / 2)
    ray = turned(*towards.T)
    ray = np.where(np.abs(ray) < 1e-9, 1e-9, ray)
    half = np.array(box.size) / 2
    first, second = (-half - from_box) / ray, (half - from_box) / ray
    near, far = np.minimum(first, second).max(1), np.maximum(first, second).min(1)
    return np.where((near < far) & (near > 0), near, np.inf)
