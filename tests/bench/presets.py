"""Named scenes that benchmarks and tests share."""

from __future__ import annotations

import importlib.util
import math
import os
from pathlib import Path

import numpy as np
import torch

from scenes.camera import Camera
from scenes.gaussians import Gaussians, SplatModel
from scenes.harmonics import sh_from_rgb
from scenes.lenses import Pinhole

SHARED = Path(os.environ.get("SIDESTEP_SHARED", Path(__file__).resolve().parents[3] / "shared"))


def load_prototype():
    """The prototype's module, `../shared/prototype/lanes.py`; FileNotFoundError saying so where it is missing."""
    path = SHARED / "prototype" / "lanes.py"
    if not path.exists():
        raise FileNotFoundError(f"{path} is missing: this row compares with the prototype; set SIDESTEP_SHARED to the folder that holds it")
    spec = importlib.util.spec_from_file_location("prototype_lanes", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def uniform(n: int, width: int = 960, height: int = 544, seed: int = 0) -> tuple[Gaussians, Camera, SplatModel]:
    """The prototype's splats as 3D Gaussians: flat, facing the camera, at rising depth, so that EWA gives the same 2D conics."""
    r = np.random.default_rng(seed)
    xy = r.uniform(0, 1, (n, 2)) * [width, height]
    sx = np.exp(r.uniform(np.log(0.7), np.log(6.0), n))
    sy = sx * np.exp(r.uniform(-1, 1, n))
    angle = r.uniform(0, np.pi, n)
    opacity = r.beta(1, 1.5, n) * 0.99
    rgb = r.uniform(0, 1, (n, 3))
    focal = float(width)
    z = np.linspace(5.0, 50.0, n)
    means = np.stack([(xy[:, 0] - width / 2) / focal * z, (xy[:, 1] - height / 2) / focal * z, z], 1)
    scales = np.stack([sx * z / focal, sy * z / focal, np.full(n, 1e-6)], 1)
    quats = np.stack([np.cos(angle / 2), np.zeros(n), np.zeros(n), np.sin(angle / 2)], 1)
    t = lambda a: torch.from_numpy(np.ascontiguousarray(a, dtype=np.float32))  # noqa: E731
    gaussians = Gaussians(t(means), t(quats), t(np.log(scales)), t(np.log(opacity / (1 - opacity))), sh_from_rgb(t(rgb))[:, None])
    camera = Camera(Pinhole(focal, focal, width / 2, height / 2), width, height, torch.eye(4, dtype=torch.float64))
    return gaussians, camera, SplatModel(projection="ewa")


def random_splats(n: int, seed: int, sh_count: int = 16, spread: float = 1.5) -> Gaussians:
    """A cloud around the origin with anisotropic scales, all opacities and view-dependent colours."""
    generator = torch.Generator().manual_seed(seed)
    r = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    return Gaussians(r(n, 3) * spread, r(n, 4), r(n, 3) * 0.5 + math.log(0.16), r(n), r(n, sh_count, 3) * 0.3)
