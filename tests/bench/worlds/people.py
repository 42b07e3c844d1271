"""Someone who walks: head, trunk, arms and legs that swing from shoulders and hips."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from tests.bench.worlds.place import Mover, Part, along
from tests.bench.worlds.solids import blob, grain, moved, plain

STRIDE = 1.4
"""Metres that two steps take."""


def walker(track: str, points: Sequence[Sequence[float]], speed: float, times_us: torch.Tensor, seed: int) -> Mover:
    """A person 1.75 m tall who goes through points `[x, y]` at a speed in m/s, and whose limbs swing as fast as that."""
    chance = np.random.default_rng(seed)
    shirt, jeans = grain(seed, tuple(chance.uniform(0.1, 0.8, 3)), 0.2, 64), grain(seed + 1, tuple(chance.uniform(0.05, 0.4, 3)), 0.2, 64)
    skin, hair = plain((0.78, 0.58, 0.46)), plain(tuple(chance.uniform(0.05, 0.3, 3)))
    trunk = Part(blob((0, 0, 1.15), (0.14, 0.2, 0.36), shirt))
    head = [Part(blob((0, 0, 1.6), (0.1, 0.09, 0.13), skin)), Part(blob((-0.02, 0, 1.66), (0.1, 0.095, 0.1), hair))]
    trajectory = along(points, speed, times_us)
    span = trajectory.span_us()
    metres = float((trajectory.world_from_body[-1] - trajectory.world_from_body[0])[:3, 3].norm())
    hertz = metres / ((span[1] - span[0]) * 1e-6) / STRIDE
    limbs = []
    for side, phase in ((1.0, 0.0), (-1.0, math.pi)):
        leg = moved(blob((0, 0, 0.46), (0.085, 0.08, 0.46), jeans), (0, 0.1 * side, 0))
        shoe = blob((0.05, 0.1 * side, 0.05), (0.14, 0.055, 0.055), hair)
        arm = blob((0, 0.25 * side, 1.12), (0.055, 0.055, 0.33), shirt)
        at = (0.0, 0.1 * side, 0.92)
        limbs += [Part(m, at, 0.42, hertz, phase) for m in (leg, shoe)]
        limbs.append(Part(arm, (0.0, 0.25 * side, 1.42), 0.35, hertz, phase + math.pi))
    return Mover(track, "pedestrian", (0.9, 0.7, 1.75), (trunk, *head, *limbs), trajectory)
