"""A made-up place as a recorded drive, and the truth beside its path, in a folder that keeps what was traced."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from recon.log import LidarPoints, Log, LogCamera, Sweep, Track
from scenes.atomic import atomic_file
from scenes.camera import Camera
from tests.bench.worlds.place import Place

SWEEP_US, COLUMNS, PARTS = 100_000, 900, 20
"""Microseconds and rays around of a sweep, which is traced in so many parts, each at its own moment."""

NOISE = 0.015
"""Metres, the standard deviation of a lidar's ranges."""

REACH = 100.0
"""Metres beyond which a lidar sees nothing."""

LOOKS = 8
"""Moments at which the truth is looked at, evenly along the drive, or up to twice as many."""

CLOSED_IN = 3.0
"""Metres within which half of a picture shows something where the camera is in it: in a car that comes, say, on whose lane we are then."""


@dataclass(frozen=True)
class Truth:
    """What would be seen: rgb `[H, W, 3]`, 0..1; depth `[H, W]` metres, inf in the sky; who `[H, W]`: as of `Place.seen`."""

    rgb: torch.Tensor
    depth: torch.Tensor
    who: torch.Tensor


def recorded(place: Place, names: Sequence[str], folder: Path) -> Log:
    """The drive as a log of these cameras: pictures and sweeps are traced where the folder does not hold them yet."""
    ego = place.ego
    cameras = {}
    for name in names:
        camera = place.rig[name]
        views = [camera.along(ego, int(t)) for t in camera.times_us]
        files = tuple(_picture(place, view, folder / f"{name}_{i:03d}.png") for i, view in enumerate(views))
        halfway = camera.times_us + camera.readout_us // 2
        poses = torch.stack([ego.near(int(t)) @ camera.body_from_cam for t in halfway])
        kind = camera.lens, camera.width, camera.height
        cameras[name] = LogCamera(name, *kind, files, halfway, poses, camera.shutter, camera.readout_us)
    stamps = next(iter(place.rig.values())).times_us.tolist()
    sweeps = tuple(Sweep(i, t, partial(_sweep, place, t, folder / f"sweep_{i:03d}.npz")) for i, t in enumerate(stamps))
    tracks = tuple(
        Track(f"veh_{i}" if m.label == "car" else f"ped_{i}", m.label, True, np.array(m.size), m.trajectory.times_us.numpy(),
              m.trajectory.world_from_body, np.full(len(m.trajectory), -1), (m.track,))
        for i, m in enumerate(place.movers, 1)
    )  # fmt: skip
    lidars = {0: np.array(place.lidar[1])}
    return Log(place.name, folder, cameras, sweeps, tracks, ego, {"name": place.name}, (next(iter(cameras)),), lidars=lidars)


def looks(place: Place, name: str, folder: Path, held_out: list[int]) -> Iterator[tuple[tuple[float, float], int, Truth]]:
    """How far aside and up, the frame's index, and what a camera would see from there, at `LOOKS` of the frames that no fit sees: all at
    once, at the middle row's moment, as scenes' cameras do. From within something nothing is looked at."""
    camera = replace(place.rig[name], shutter="global", readout_us=0)
    moments = camera.times_us + place.rig[name].readout_us // 2
    some = held_out[:: max(1, len(held_out) // LOOKS)]
    for left, up in place.aside:
        path = place.ego.shifted(lateral=left, vertical=up)
        for i in some:
            view = camera.along(path, int(moments[i]))
            truth = _truth(place, view, folder / f"{name}_{i:03d}_{left:+g}_{up:+g}")
            if truth.depth.median() > CLOSED_IN:
                yield (left, up), i, truth


def _picture(place: Place, view: Camera, file: Path) -> Path:
    if not file.exists():
        _save(place.seen(view)[0], file)
    return file


def _save(rgb: torch.Tensor, file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(file) as part:
        Image.fromarray((rgb.numpy() * 255).round().astype(np.uint8)).save(part, "PNG")


def _keep(file: Path, **arrays: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(file) as part:
        np.savez_compressed(part, **arrays)  # type: ignore[arg-type] - numpy's own stub takes no dict


def _truth(place: Place, view: Camera, stem: Path) -> Truth:
    picture, measured = stem.with_name(f"{stem.name}.png"), stem.with_name(f"{stem.name}.npz")
    if not (picture.exists() and measured.exists()):
        rgb, depth, who = place.seen(view)
        _keep(measured, depth=depth.numpy(), who=who.numpy().astype(np.int8))
        _save(rgb, picture)
    with np.load(measured) as kept, Image.open(picture) as shown:
        rgb = torch.from_numpy(np.asarray(shown).copy()).float() / 255
        return Truth(rgb, torch.from_numpy(kept["depth"]), torch.from_numpy(kept["who"].astype(np.int64)))


def _sweep(place: Place, stamp: int, file: Path) -> LidarPoints:
    """One turn of the lidar that ends at its stamp, from behind the car and clockwise, each part from where the car is at that moment."""
    if not file.exists():
        elevations, mount = np.radians(place.lidar[0]), torch.tensor(place.lidar[1], dtype=torch.float64)
        chance, found = np.random.default_rng(stamp), []
        for k in range(PARTS):
            time = stamp - SWEEP_US + SWEEP_US * k // PARTS
            azimuth = np.pi - 2 * np.pi * (np.arange(COLUMNS // PARTS) / COLUMNS + k / PARTS)
            a, e = (v.ravel() for v in np.meshgrid(azimuth, elevations))
            rays = torch.from_numpy(np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], 1))
            pose = place.ego.near(time)
            origin, rays = pose[:3, :3] @ mount + pose[:3, 3], rays @ pose[:3, :3].T
            metres, _ = place.distances(origin.float().expand(len(rays), 3), rays.float(), time)
            hit = metres < REACH
            ranges = metres[hit].double() + torch.from_numpy(chance.normal(0, NOISE, int(hit.sum())))
            found.append((origin + ranges[:, None] * rays[hit], np.full(int(hit.sum()), time)))
        _keep(file, xyz=torch.cat([xyz for xyz, _ in found]).numpy(), times=np.concatenate([t for _, t in found]))
    with np.load(file) as kept:
        return LidarPoints(kept["xyz"], kept["times"], np.zeros(len(kept["xyz"]), np.int64))
