"""Named scenes that benchmarks and tests share."""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from scenes.camera import Camera
from scenes.gaussians import Gaussians, Placed, SplatModel
from scenes.harmonics import sh_from_rgb
from scenes.lenses import Pinhole
from scenes.poses import pose_from, translation
from scenes.space_order import space_order

REPOSITORY = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("SIDESTEP_SHARED", REPOSITORY.parent / "shared"))
DRIVE = REPOSITORY / "examples" / "data" / "drive002"
STILL = torch.eye(4, dtype=torch.float64)


class Missing(Exception):
    """A preset whose data is not here; says what to do."""


@dataclass(frozen=True)
class Preset:
    """What to draw, from where, and by which model."""

    placed: list[Placed]
    camera: Camera
    model: SplatModel

    def __len__(self) -> int:
        return sum(len(p.gaussians) for p in self.placed)


def drive(width: int, height: int, folder: Path | None = None) -> Preset:
    """A scene folder's front camera amid its drive, the actors of that moment included; the bundled demo's scene by default."""
    from scenes import load

    scene = load(folder or DRIVE)
    rig = scene.rig["front_camera"] if "front_camera" in scene.rig else next(iter(scene.rig.values()))
    times = rig.times_us if len(rig.times_us) else scene.ego.times_us
    when = int(times[len(times) // 2])
    camera = Camera(rig.lens, rig.width, rig.height, scene.ego.at(when) @ rig.body_from_cam, time_us=when)
    return Preset(scene.placed(when), camera.resized(width, height), scene.model)


def street(count: int, folder: Path | None = None) -> Preset:
    """The drive's background laid around itself on a grid of 150 m until there are `count` splats, each copy in order of space: a city of
    which the camera in its middle sees little."""
    first = drive(960, 540, folder)
    g = first.placed[0].gaussians
    g = g.select(space_order(g.means))
    copies = -(-count // len(g))
    side = math.ceil(math.sqrt(copies))
    cells = sorted(((x, y) for x in range(-side, side + 1) for y in range(-side, side + 1)), key=lambda c: (max(map(abs, c)), c))
    tiles = [replace(g, means=g.means + torch.tensor([150.0 * x, 150.0 * y, 0.0])) for x, y in cells[:copies]]
    whole = Gaussians.cat(tiles).select(torch.arange(count))
    return Preset([Placed(whole, first.placed[0].world_from_local)], first.camera, first.model)


def biker() -> Preset:
    """A person on a bicycle from the shared data, seen from 3 m."""
    from scenes import load

    path = SHARED / "data" / "splats" / "biker.compressed.ply"
    if not path.exists():
        raise Missing(f"{path} is missing; set SIDESTEP_SHARED to the folder that holds data/")
    try:
        found = load(path)
    except ValueError as error:
        raise Missing(f"{path.name} cannot be read yet: {error}") from error
    g = found if isinstance(found, Gaussians) else found.gaussians
    centre, spread = g.means.median(0).values.double(), float((g.means - g.means.median(0).values).norm(dim=1).quantile(0.9))
    pose = translation(*centre.tolist()) @ pose_from([1.0, 0, 0, 0], [0, 0, -3 * spread])
    return Preset([Placed(g, STILL)], Camera(Pinhole(960.0, 960.0, 480.0, 270.0), 960, 540, pose), SplatModel(projection="ewa"))


def presets(drive_folder: Path | None = None, lund_folder: Path | None = None) -> dict[str, Callable[[], Preset]]:
    """All presets by name, made when called; `Missing` where their data is not here."""

    def lund() -> Preset:
        if lund_folder is None:
            raise Missing("no scene: `sidestep recon ../shared/data/lund -o FOLDER --camera-height 1.6m`, then pass --lund FOLDER")
        return drive(960, 540, lund_folder)

    def uniform_of(n: int) -> Preset:
        g, camera, model = uniform(n)
        return Preset([Placed(g, STILL)], camera, model)

    sizes = [(480, 270), (960, 540), (1920, 1080)]
    return {
        "uniform-100k": lambda: uniform_of(100_000),
        "uniform-500k": lambda: uniform_of(500_000),
        **{f"drive-{w}x{h}": lambda w=w, h=h: drive(w, h, drive_folder) for w, h in sizes},  # type: ignore[misc]
        "lund": lund,
        "biker": biker,
        "street-1M": lambda: street(1_000_000, drive_folder),
        "street-3M": lambda: street(3_000_000, drive_folder),
    }


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
