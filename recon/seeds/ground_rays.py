"""Where rays meet the ground."""

from __future__ import annotations

import numpy as np
import torch

from scenes.ground import Ground

STEPS = np.geomspace(0.5, 2000.0, 64)
"""Multiples of a ray at which it is asked whether it is under the ground; a crest that it enters and leaves between two is missed."""

LEVEL = 1e-3
"""A ray that falls by less with each of its lengths is taken to meet nothing: so far away the ground is a guess."""

ROUNDS = 4
"""Of false position between two steps; ground that does not bend there takes one."""


def ground_hits(eye: np.ndarray, rays: np.ndarray, ground: Ground, below: float = 0.0) -> np.ndarray:
    """Multiples `[...]` of rays `[..., 3]` from `eye` `[3]` at which they come to be `below` metres under the ground, by ray marching.

    Infinite where they rise or are level, where they do not come there (a hill may fall as fast), and all of them where the eye itself is
    under it: such a ground is wrong.
    """
    flat = rays.reshape(-1, 3)

    def above(which: np.ndarray, times: np.ndarray) -> np.ndarray:
        at = eye + times[:, None] * flat[which]
        return at[:, 2] + below - ground.height(torch.from_numpy(at[:, :2])).numpy()

    hits = np.full(len(flat), np.inf)
    going = np.flatnonzero(flat[:, 2] < -LEVEL)
    near, far, over, under = (np.zeros(len(flat)) for _ in range(4))
    over[going] = above(going, near[going])
    going = met = going[over[going] > 0]
    for step in STEPS:
        far[going] = step
        under[going] = now = above(going, far[going])
        near[going[now > 0]], over[going[now > 0]] = step, now[now > 0]
        going = going[now > 0]
    met = np.setdiff1d(met, going, assume_unique=True)
    for _ in range(ROUNDS + 1):
        hits[met] = near[met] + over[met] / (over[met] - under[met]) * (far[met] - near[met])
        now = above(met, hits[met])
        short, beyond = met[now > 0], met[now <= 0]
        near[short], over[short] = hits[short], now[now > 0]
        far[beyond], under[beyond] = hits[beyond], now[now <= 0]
    return hits.reshape(rays.shape[:-1])
