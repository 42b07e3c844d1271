"""A lidar that turns on a car, in a street of boxes of which some move: the sweeps it would have made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
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


def drive(boxes: Sequence[Box], count: int = 36, speed: float = 8.0, rows: int = 32, columns: int = 720, seed: int = 0) -> Log:
    """A log of `count` sweeps, ten a second, by a car that goes along x; it has no boxes and no cameras."""
    times = np.arange(-1, count + 1) * TURN_US
    ego = Trajectory(torch.from_numpy(times), torch.stack([translation(speed * t / 1e6, 0.0, 0.0) for t in times]))
    noise = np.random.default_rng(seed)
    sweeps = tuple(_sweep(i, boxes, _rays(i, speed, rows, columns), noise) for i in range(count))
    return Log("street", Path("street"), {}, sweeps, (), ego, {}, lidars={0: MOUNT})


@dataclass(frozen=True, eq=False)
class Rays:
    """One turn: `eye` and `towards` `[N, 3]`, and when, `[N]` us, of which there is one for each column: `column` `[N]`."""

    eye: np.ndarray
    towards: np.ndarray
    when: np.ndarray
    moments: np.ndarray
    column: np.ndarray


@cache
def _rays(index: int, speed: float, rows: int, columns: int) -> Rays:
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    moments = index * TURN_US + np.round(azimuth / (2 * np.pi) * TURN_US).astype(np.int64)
    a, e = (x.ravel() for x in np.meshgrid(azimuth, np.radians(np.linspace(-20, 8, rows))))
    towards = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1)
    when, column = np.tile(moments, rows), np.tile(np.arange(columns), rows)
    return Rays(MOUNT + np.stack([speed * when / 1e6, 0 * when, 0 * when], 1), towards, when, moments, column)


def _sweep(index: int, boxes: Sequence[Box], rays: Rays, noise: np.random.Generator) -> Sweep:
    with np.errstate(divide="ignore"):
        away = np.where(rays.towards[:, 2] < 0, -rays.eye[:, 2] / rays.towards[:, 2], np.inf)
    for box in boxes:
        away = np.minimum(away, _struck(box, rays))
    hit = away < 90
    xyz = rays.eye[hit] + rays.towards[hit] * (away[hit] + noise.normal(0, NOISE, hit.sum()))[:, None]
    points = LidarPoints(xyz, rays.when[hit], np.zeros(int(hit.sum()), np.int64))
    return Sweep(index, index * TURN_US, lambda: points)


@cache
def _struck(box: Box, rays: Rays) -> np.ndarray:
    """How far `[N]` rays go until they strike the box where it is at their moments; inf where they miss (slabs, Kay and Kajiya 1986)."""
    placed = np.array([box.at(t / 1e6) for t in rays.moments])
    x, y, yaw = placed[rays.column].T
    cos, sin = np.cos(yaw), np.sin(yaw)

    def turned(dx: np.ndarray, dy: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.stack([cos * dx + sin * dy, -sin * dx + cos * dy, z], 1)

    from_box = turned(rays.eye[:, 0] - x, rays.eye[:, 1] - y, rays.eye[:, 2] - box.size[2] / 2)
    ray = turned(*rays.towards.T)
    ray = np.where(np.abs(ray) < 1e-9, 1e-9, ray)
    half = np.array(box.size) / 2
    first, second = (-half - from_box) / ray, (half - from_box) / ray
    near, far = np.minimum(first, second).max(1), np.maximum(first, second).min(1)
    return np.where((near < far) & (near > 0), near, np.inf).astype(np.float32)
