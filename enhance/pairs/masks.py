"""Random regions with soft edges: where a degradation falls when no instance mask says so."""

from __future__ import annotations

import numpy as np
from scipy import ndimage


def random_mask(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """One region, float32 `[height, width]` in 0..1: an ellipse, a box, a blob or superpixels, of 2 to 40 percent of the image."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    area = np.exp(rng.uniform(np.log(0.02), np.log(0.4))) * height * width
    aspect = np.exp(rng.uniform(-0.7, 0.7))
    a, b = np.sqrt(area / np.pi * aspect), np.sqrt(area / np.pi / aspect)
    cx, cy, turn = rng.uniform(0.1, 0.9) * width, rng.uniform(0.1, 0.9) * height, rng.normal(0, 0.3)
    u = ((x - cx) * np.cos(turn) + (y - cy) * np.sin(turn)) / a
    v = (-(x - cx) * np.sin(turn) + (y - cy) * np.cos(turn)) / b
    shape = rng.integers(4)
    if shape == 0:
        inside = u**2 + v**2 < 1
    elif shape == 1:
        inside = np.maximum(abs(u), abs(v)) < 0.886
    elif shape == 2:
        inside = np.hypot(u, v) < _wobble(rng, np.arctan2(v, u))
    else:
        inside = _cells(rng, u, v)
    mask = inside.astype(np.float32)
    soft = rng.choice([0.0, rng.uniform(0.4, 2.5)])
    return ndimage.gaussian_filter(mask, soft) if soft else mask


def _wobble(rng: np.random.Generator, angle: np.ndarray) -> np.ndarray:
    """A radius that goes once round with a few random harmonics: a blob."""
    radius = np.ones_like(angle)
    for k in range(2, 7):
        radius += rng.normal(0, 0.35 / k) * np.cos(k * angle + rng.uniform(0, 2 * np.pi))
    return radius


def _cells(rng: np.random.Generator, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The superpixels (Voronoi cells of random seeds) whose seed lies in the unit disc."""
    seeds = rng.uniform(-1.8, 1.8, (40, 2)).astype(np.float32)
    near = np.hypot(seeds[:, 0], seeds[:, 1]) < 1
    nearest = ((u[..., None] - seeds[:, 0]) ** 2 + (v[..., None] - seeds[:, 1]) ** 2).argmin(-1)
    return near[nearest]
