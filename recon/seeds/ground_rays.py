"""Where rays meet the ground."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from recon.kernels.ground import Grid, march
from render.launch import run, stage, view
from scenes.ground import Ground

STEPS = torch.from_numpy(np.geomspace(0.5, 2000.0, 64))
"""Multiples of a ray at which it is asked whether it is under the ground; a crest that it enters and leaves between two is missed."""

LEVEL, UNDER = 1e-3, 5.0
"""A ray that falls by less with each of its lengths, or against the ground as that lies so many metres around the eye, is taken to meet
nothing: so far away the ground is a guess."""

ROUNDS = 4
"""Of false position between two steps; ground that does not bend there takes one."""


def ground_hits(eye: np.ndarray, rays: np.ndarray, ground: Ground, below: float = 0.0) -> np.ndarray:
    """Multiples `[...]` of rays `[..., 3]` from `eye` `[3]` at which they come to be `below` metres under the ground, by ray marching.

    Infinite where they rise or are level, and do so over ground that goes on as it lies under the eye (up a hill the road does too), where
    they do not come there (a hill may fall as fast), and all of them where the eye itself is under it: such a ground is wrong.
    """
    around = torch.tensor([[UNDER, 0.0], [-UNDER, 0.0], [0.0, UNDER], [0.0, -UNDER]], dtype=torch.float64)
    ahead, back, left, right = ground.height(torch.from_numpy(eye[:2].copy()) + around).tolist()
    flat = torch.from_numpy(rays.reshape(-1, 3)).double().contiguous()
    hits = torch.empty(len(flat), dtype=torch.float64)
    grid = Grid()
    (grid.x, grid.y), grid.cell = ground.origin, ground.cell
    with stage(hits.device):
        slope = wp.vec2d((ahead - back) / (2 * UNDER), (left - right) / (2 * UNDER))
        told = [slope, wp.vec3d(eye[0], eye[1], eye[2] + below), view(flat, wp.vec3d), view(STEPS, wp.float64), ROUNDS + 1, LEVEL]
        run(march, len(flat), [view(ground.heights, float), grid, *told, view(hits, wp.float64)], hits.device)
    return hits.numpy().reshape(rays.shape[:-1])
