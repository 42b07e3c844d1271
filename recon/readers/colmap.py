"""Reads a COLMAP model with its pictures (Schönberger and Frahm 2016; the files as in COLMAP's doc/format.rst).

A model has no clock: pictures follow each other half a second apart in the order of their names (and of the numbers in them), unless
`times.json` beside the model's files gives microseconds by picture name. The body is the first camera, turned to x forward, y left, z up.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from recon.log import Log, LogCamera, SparsePoints, image_size
from recon.readers.gauge import find_gauge
from recon.readers.order import recorded
from recon.readers.sfm import Model, ModelCamera, is_model, read_model
from recon.readers.stated import stating
from scenes.lenses import Fisheye, Lens, OpenCV, Pinhole
from scenes.names import nearest
from scenes.poses import CAM_FROM_FLU
from scenes.trajectory import Trajectory

STEP_US = 500_000
FASTEST_US = 100
"""Microseconds between a picture and the next, below which a clock counts seconds or milliseconds."""

APART = 300.0
"""Metres between a picture and the next from which on a model is none of a place: nothing ties its pictures to each other."""


def find_model(folder: Path) -> Path | None:
    """The model's folder in a COLMAP workspace: `folder` itself, its sparse/0, or another one up to two levels down; the fullest."""
    inside = [p for level in ("*", "*/*") for p in sorted(folder.glob(level)) if p.is_dir()]
    models = [p for p in [folder, *inside] if is_model(p)]
    return max(models, key=lambda p: sum(f.stat().st_size for f in p.glob("images.*")), default=None)


def read_colmap(path: Path, camera_height: float | None = None, metres_per_unit: float | None = None, pictures: Path | None = None) -> Log:
    """The drive in a COLMAP workspace: a model and the pictures it registers.

    camera_height: metres of the cameras above the ground; metres_per_unit: of the model's unit; without either the log is not
    metric. pictures: their folder, found in the workspace where None. FileNotFoundError and ValueError name the file or lens that is
    missing or wrong.
    """
    where = find_model(path)
    if where is None:
        raise FileNotFoundError(f"{path} holds no COLMAP model; it has cameras.bin, images.bin and points3D.bin, as in {path / 'sparse/0'}")
    model = read_model(where)
    names = camera_names(model)
    moments = _moments(where, model)
    poses = np.stack([np.linalg.inv(i.cam_from_world) for i in model.images])
    lead = _lead(model)
    gauge = find_gauge(poses[[i.camera == lead for i in model.images]], model.xyz, camera_height, metres_per_unit)
    placed = gauge.poses(poses)

    mine = [k for k, i in enumerate(model.images) if i.camera == lead]
    order = sorted(mine, key=lambda k: moments[k])
    ego = Trajectory(torch.tensor([moments[k] for k in order]), placed[order] @ CAM_FROM_FLU)
    steps = ego.world_from_body[:, :3, 3].diff(dim=0).norm(dim=1)
    if len(steps) and (step := float(steps.median())) > APART:
        fix = "check the scale that was given" if metres_per_unit else "take pictures closer together, of more that stands still"
        fix += f", and delete {path} to begin again" if path.suffix == ".sfm" else ""
        raise ValueError(f"{where} has its pictures {step:.3g} m from one to the next, which is astray; {fix}")
    pictures = pictures or _picture_folder(path, where, model.images[0].name)
    cameras, seen = {}, {}
    for key in sorted(names, key=lambda k: (k != lead, names[k])):
        chosen = [k for k, i in enumerate(model.images) if i.camera == key and ego.covers(moments[k])]
        chosen.sort(key=lambda k: moments[k])
        if not chosen:
            continue
        files = tuple(pictures / model.images[k].name for k in chosen)
        for file in files:
            if not file.is_file():
                raise FileNotFoundError(f"{file} is missing; the model in {where} registers it.{_beside(file)}")
        found, size = model.cameras[key], image_size(files[0])
        if size != (found.width, found.height):
            fix = f"put the pictures that the model was made of into {pictures}, or make a model of these"
            taken = f"{files[0]} is {size[0]}x{size[1]}, but the model in {where} has a camera of {found.width}x{found.height}"
            raise ValueError(f"{taken}; {fix}")
        times = torch.tensor([moments[k] for k in chosen])
        cameras[names[key]] = LogCamera(names[key], lens_of(found, where), found.width, found.height, files, times, placed[chosen])
        seen[names[key]] = tuple(model.images[k].points for k in chosen)
    about = path.resolve()
    meta: dict = {
        "name": about.parent.name if about.name in ("images", "sparse") else about.name.removesuffix(".sfm"),
        "source": f"COLMAP model of {len(model.images)} pictures in {about.name}",
        "body": f"camera {names[lead]}, turned to x forward, y left, z up",
        "metric": gauge.metric,
        "world_from_model": {"rotation": gauge.rotation.tolist(), "origin": gauge.origin.tolist(), "scale": gauge.scale},
    }
    points = SparsePoints(gauge.points(model.xyz), seen) if len(model.xyz) else None  # poses alone: then pictures are asked for points
    return Log(meta["name"], path, cameras, (), (), ego, meta, tuple(cameras), points)


def lens_of(camera: ModelCamera, where: Path) -> Lens:
    """Our lens for COLMAP's (src/colmap/sensor/models.h): the same formulas, parameters in another order. ValueError for other lenses."""
    p = camera.params
    make = LENSES.get(camera.lens)
    if make is None:
        fix = "undistort the pictures with: colmap image_undistorter"
        raise ValueError(f"{where} has a camera with the lens {camera.lens}; read are {', '.join(LENSES)}. For others, {fix}")
    with stating(f"{where}, camera with the lens {camera.lens}"):
        return make(*p)


LENSES: dict[str, Callable[..., Lens]] = {
    "SIMPLE_PINHOLE": lambda f, cx, cy: Pinhole(f, f, cx, cy),
    "PINHOLE": Pinhole,
    "SIMPLE_RADIAL": lambda f, cx, cy, k: OpenCV(f, f, cx, cy, k),
    "RADIAL": lambda f, cx, cy, k1, k2: OpenCV(f, f, cx, cy, k1, k2),
    "OPENCV": OpenCV,
    "FULL_OPENCV": OpenCV,
    "SIMPLE_RADIAL_FISHEYE": lambda f, cx, cy, k: Fisheye(f, f, cx, cy, k),
    "RADIAL_FISHEYE": lambda f, cx, cy, k1, k2: Fisheye(f, f, cx, cy, k1, k2),
    "OPENCV_FISHEYE": Fisheye,
}


def colmap_lens(lens: Lens, where: Path) -> tuple[str, tuple[float, ...]]:
    """COLMAP's lens model for ours, the reverse of `lens_of`. ValueError for lenses that COLMAP has not."""
    model = {Pinhole: "PINHOLE", OpenCV: "FULL_OPENCV", Fisheye: "OPENCV_FISHEYE"}.get(type(lens))
    params = tuple(lens.params().tolist())
    if model == "FULL_OPENCV" and not any(params[12:]):
        params = params[:12]
    elif model in (None, "FULL_OPENCV"):
        what = f"lens {lens.kind}" + " with thin prisms" * (model is not None)
        raise ValueError(f"{where} has no lidar, and COLMAP, which finds depths in pictures, has no {what} as its cameras have; add lidar")
    return model, params


def camera_names(model: Model) -> dict[int, str]:
    """A name for every camera that took a picture: "camera" for the only one, else its pictures' folder, else camera_<id>.

    ValueError where nearly every picture has a camera of its own: one lens a picture is no rig.
    """
    taken = {key: [i.name for i in model.images if i.camera == key] for key in sorted({i.camera for i in model.images})}
    if len(taken) == 1:
        return {key: "camera" for key in taken}
    if len(model.images) < 2 * len(taken):
        fix = "let COLMAP share one: colmap feature_extractor --ImageReader.single_camera 1"
        raise ValueError(f"the model has {len(taken)} cameras for {len(model.images)} pictures; {fix}")
    folders = {key: {str(Path(n).parent) for n in some} for key, some in taken.items()}
    flat = [next(iter(f)) for f in folders.values() if len(f) == 1]
    if len(set(flat)) == len(taken) and "." not in flat:
        return {key: re.sub(r"\W", "_", next(iter(f))) for key, f in folders.items()}
    return {key: f"camera_{key}" for key in taken}


def _lead(model: Model) -> int:
    """The camera that stands for the body: the one with most pictures, one whose name says front among equals."""
    keys = sorted({i.camera for i in model.images})
    count = {key: sum(i.camera == key for i in model.images) for key in keys}
    ahead = {key: any("front" in i.name.lower() for i in model.images if i.camera == key) for key in keys}
    return max(keys, key=lambda k: (count[k], ahead[k], -k))


def _moments(where: Path, model: Model) -> list[int]:
    """Microseconds of every picture. Those of one frame of a rig share a moment, as do those of several cameras whose names differ in the
    cameras' folders alone. ValueError where that makes a camera take two pictures at one moment."""
    clock = where / "times.json"
    if clock.is_file():
        try:
            times = json.loads(clock.read_text())
            told = [times[i.name] for i in model.images]
            moments = [int(t) for t in told]
        except (json.JSONDecodeError, UnicodeDecodeError, TypeError, KeyError, ValueError) as problem:
            raise ValueError(f"{clock} must give whole microseconds by picture name ({problem!r})") from None
        rising = np.unique(moments)
        if moments != told or len(rising) > 1 and np.median(np.diff(rising)) < FASTEST_US:
            raise ValueError(f"{clock} must give whole microseconds by picture name; it has {told[0]!r} for {model.images[0].name}")
        fix = f"give them different times in {clock}"
    else:
        names = _without_cameras(model)
        keys = [str(i.frame) if model.rigid else name for i, name in zip(model.images, names, strict=True)]
        first: dict[str, str] = {}
        for key, name in zip(keys, names, strict=True):
            first.setdefault(key, name)
        order = {key: i for i, key in enumerate(sorted(first, key=lambda k: recorded(first[k])))}
        moments = [order[key] * STEP_US for key in keys]
        fix = f"give microseconds by picture name in {clock}"
    taken: dict[tuple[int, int], str] = {}
    for image, moment in zip(model.images, moments, strict=True):
        other = taken.setdefault((image.camera, moment), image.name)
        if other != image.name:
            raise ValueError(f"{where} has one camera take {other} and {image.name} at one moment; {fix}")
    return moments


def _without_cameras(model: Model) -> list[str]:
    """The pictures' names; those of several cameras without the folders that all pictures of the camera share, and without suffix."""
    names = [i.name for i in model.images]
    cameras = {i.camera for i in model.images}
    if len(cameras) == 1:
        return names
    shared = {key: set.intersection(*(set(Path(i.name).parts[:-1]) for i in model.images if i.camera == key)) for key in cameras}
    paths = [Path(name).with_suffix("") for name in names]
    return ["/".join(p for p in path.parts if p not in shared[i.camera]) for path, i in zip(paths, model.images, strict=True)]


def _picture_folder(path: Path, where: Path, name: str) -> Path:
    """Where the pictures lie: in the workspace, its images/, or beside the model."""
    tried = [path / "images", path, where / "images", where.parent / "images", where.parent.parent / "images", path.parent / "images"]
    for folder in tried:
        if (folder / name).is_file():
            return folder
    raise FileNotFoundError(f"{path / 'images' / name} is missing; put the pictures that the model registers into {path / 'images'}")


def _beside(file: Path) -> str:
    return nearest(file.name, [p.name for p in file.parent.iterdir()] if file.parent.is_dir() else [])
