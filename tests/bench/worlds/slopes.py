"""Roads that wind, go up and down: what lies along them, and what stands and drives on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from render.tracer import Mesh
from scenes.trajectory import Trajectory
from tests.bench.worlds.place import Level
from tests.bench.worlds.solids import joined, panel

Height = Callable[[np.ndarray], np.ndarray]
"""Metres that the ground is high at x, wherever y."""

STEP = 0.5
"""Metres ahead and behind at which a slope is told."""


def level(height: Height) -> Level:
    return lambda x, y: torch.from_numpy(height(x.numpy())).to(x.dtype)


def strip(way: np.ndarray, ends: Sequence[tuple[float, float]], texture: np.ndarray, tile: float, height: Height) -> Mesh:
    """A band along a way over the ground `[K, 2]`, plane between its points, from one place (metres to the left, metres up) to another:
    the right one first where it is seen from above."""
    forth = np.gradient(way, axis=0)
    left = np.stack([-forth[:, 1], forth[:, 0]], 1) / np.linalg.norm(forth, axis=1, keepdims=True)
    edges = []
    for aside, up in ends:
        edge = way + aside * left
        edges.append(np.concatenate([edge, up + height(edge[:, :1])], 1))
    gone, out = 0.0, []
    for a, b, c, d in zip(edges[0][:-1], edges[0][1:], edges[1][1:], edges[1][:-1], strict=True):
        piece = panel(a, b - a, d - a, texture, tile)
        normal = np.cross(b - a, d - a)
        out.append(replace(
            piece, vertices=np.stack([a, b, c, d]).astype(np.float32), uvs=piece.uvs + [gone / tile, 0],
            normals=np.broadcast_to(normal / np.linalg.norm(normal), (2, 3, 3)).astype(np.float32),
        ))  # fmt: skip
        gone += float(np.linalg.norm(b - a))
    return joined(out)


def stood(pose: torch.Tensor, height: Height) -> torch.Tensor:
    """A pose over level ground `[4, 4]`, put on the ground."""
    x, forth = pose[0, 3].item(), pose[:3, 0].numpy()
    slope = float(height(np.array(x + STEP)) - height(np.array(x - STEP))) / (2 * STEP)
    up, ahead = np.array([-slope, 0.0, 1.0]), forth + [0, 0, slope * forth[0]]
    up, ahead = up / np.linalg.norm(up), ahead / np.linalg.norm(ahead)
    out = pose.clone()
    out[:3, :3] = torch.from_numpy(np.stack([ahead, np.cross(up, ahead), up], 1))
    out[2, 3] += float(height(np.array(x)))
    return out


def over(trajectory: Trajectory, height: Height) -> Trajectory:
    """A level trajectory, laid on the ground."""
    return replace(trajectory, world_from_body=torch.stack([stood(pose, height) for pose in trajectory.world_from_body]))
