"""Reads a COLMAP model with its pictures (Schönberger and Frahm 2016; the files as in COLMAP's doc/format.rst).

A model has no clock: recon/readers/moments.py tells when its pictures were taken. The body is the first camera, turned to x forward, y
left, z up.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from recon.log import FETCH, Log, LogCamera, SparsePoints
from recon.readers.colmap_model import Model, ModelCamera, is_model, read_model
from recon.readers.gauge import find_gauge
from recon.readers.moments import moments_of
from recon.readers.order import names_apart
from recon.readers.stated import stating
from scenes.lenses import Fisheye, Lens, OpenCV, Pinhole
from scenes.names import nearest
from scenes.pictures import is_turned, opened
from scenes.poses import CAM_FROM_FLU
from scenes.trajectory import Trajectory

APART = 300.0
"""Metres between a picture and the next from which on a model is none of a place: nothing ties its pictures to each other."""


WORKSPACE = ".sfm"
"""How the name of a folder ends that keeps where the photos, or the frames of the video, beside it were taken."""


def find_model(folder: Path) -> Path | None:
    """The model's folder in a COLMAP workspace: `folder` itself, its sparse/0, another one up to two levels down, or colmap/sparse/0, as
    nerfstudio has it; of several equally deep the fullest, as those that are deeper may be of other pictures (distorted/sparse/0), as what
    is kept of photos and videos in the folder is."""
    for level in ("", "*", "*/*", "*/sparse/*"):
        below = [p for p in sorted(folder.glob(level)) if not kept_of_others(folder, p)] if level else [folder]
        models = [p for p in below if p.is_dir() and is_model(p)]
        if models:
            return max(models, key=lambda p: sum(f.stat().st_size for f in p.glob("images.*")))
    return None


def kept_of_others(folder: Path, path: Path) -> bool:
    """Whether what lies below a folder was made of photos or a video there, and keeps where they were taken (`WORKSPACE`)."""
    return any(part.endswith((WORKSPACE, f"{WORKSPACE}.partial")) for part in path.relative_to(folder).parts)


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
    if len(model.images) == 1:
        fix = "make a model of more pictures, from different places"
        raise ValueError(f"{where} registers one picture, {model.images[0].name}, and one has no depth; {fix}")
    names = camera_names(model)
    lead = _lead(model)
    moments, clock = moments_of(where, model, lead)
    poses = np.stack([np.linalg.inv(i.cam_from_world) for i in model.images])
    gauge = find_gauge(poses[[i.camera == lead for i in model.images]], model.xyz, camera_height, metres_per_unit)
    placed = gauge.poses(poses)

    mine = [k for k, i in enumerate(model.images) if i.camera == lead]
    order = sorted(mine, key=lambda k: moments[k])
    ego = Trajectory(torch.tensor([moments[k] for k in order]), placed[order] @ CAM_FROM_FLU)
    steps = ego.world_from_body[:, :3, 3].diff(dim=0).norm(dim=1)
    if len(steps) and (step := float(steps.median())) > APART:
        fix = "check the scale that was given" if metres_per_unit else "take pictures closer together, of more that stands still"
        fix += f", and delete {path} to begin again" if path.suffix == WORKSPACE else ""
        raise ValueError(f"{where} has its pictures {step:.3g} m from one to the next, which is implausible; {fix}")
    pictures = pictures or _picture_folder(path, where, model.images[0].name)
    cameras, seen = {}, {}
    firsts: list[Path] = []
    for key in sorted(names, key=lambda k: (k != lead, names[k])):
        chosen = sorted((k for k, i in enumerate(model.images) if i.camera == key), key=lambda k: moments[k])
        if not any(ego.covers(moments[k]) for k in chosen):
            fix = f"name pictures of one moment alike, as front/001.jpg and left/001.jpg, or give times in {where / 'times.json'}"
            print(f"{path}: camera {names[key]} is left out, for it took no picture while {names[lead]} did; {fix}", file=sys.stderr)
            continue
        files = tuple(pictures / model.images[k].name for k in chosen)
        for file in files:
            if not file.is_file():
                again = f"; where it was taken away, delete {path} to begin again" * (path.suffix == WORKSPACE)
                raise FileNotFoundError(f"{file} is missing; the model in {where} registers it{again}.{_beside(file, files)}")
        _check_pictures(path, where, files, found := model.cameras[key])
        firsts.append(files[0])
        times = torch.tensor([moments[k] for k in chosen])
        cameras[names[key]] = LogCamera(names[key], lens_of(found, where), found.width, found.height, files, times, placed[chosen])
        seen[names[key]] = tuple(model.images[k].points for k in chosen)
    _tell_masked(firsts, pictures.with_name("masks"))
    about = path.resolve()
    meta: dict = {
        "name": about.parent.name if about.name in ("images", "sparse") else about.name.removesuffix(WORKSPACE),
        "source": f"COLMAP model of {len(model.images)} pictures in {about.name}",
        "body": f"camera {names[lead]}, turned to x forward, y left, z up",
        "metric": gauge.metric,
        "clock": clock,
        "world_from_model": {"rotation": gauge.rotation.tolist(), "origin": gauge.origin.tolist(), "scale": gauge.scale},
    }
    observed = any(len(shown) for frames in seen.values() for shown in frames)
    points = SparsePoints(gauge.points(model.xyz), seen) if observed else None  # poses alone: then pictures are asked for points
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
    "SIMPLE_FISHEYE": lambda f, cx, cy: Fisheye(f, f, cx, cy),
    "FISHEYE": Fisheye,
    "SIMPLE_RADIAL_FISHEYE": lambda f, cx, cy, k: Fisheye(f, f, cx, cy, k),
    "RADIAL_FISHEYE": lambda f, cx, cy, k1, k2: Fisheye(f, f, cx, cy, k1, k2),
    "OPENCV_FISHEYE": Fisheye,
}


def camera_names(model: Model) -> dict[int, str]:
    """A name for every camera that took a picture: "camera" for the only one, else what its pictures' names call it (`names_apart`), else
    camera_<id>.

    ValueError where nearly every picture has a camera of its own: one lens a picture is no rig.
    """
    taken = {key: [i.name for i in model.images if i.camera == key] for key in sorted({i.camera for i in model.images})}
    if len(taken) == 1:
        return {key: "camera" for key in taken}
    if len(model.images) < 2 * len(taken):
        fix = "let COLMAP share one: colmap feature_extractor --ImageReader.single_camera 1"
        raise ValueError(f"the model has {len(taken)} cameras for {len(model.images)} pictures; {fix}")
    return names_apart(taken) or {key: f"camera_{key}" for key in taken}


def _lead(model: Model) -> int:
    """The camera that stands for the body: of those with at least half as many pictures as any has, one whose name says front, else the one
    with most. A rig's front camera lacks one that was not registered now and then, and to the left of another is not the car's left."""
    keys = sorted({i.camera for i in model.images})
    count = {key: sum(i.camera == key for i in model.images) for key in keys}
    ahead = {key: any("front" in i.name.lower() for i in model.images if i.camera == key) for key in keys}
    return max((k for k in keys if 2 * count[k] >= max(count.values())), key=lambda k: (ahead[k], count[k], -k))


def _picture_folder(path: Path, where: Path, name: str) -> Path:
    """Where the pictures lie: in the workspace, its images/, or beside the model."""
    tried = [path / "images", path, where / "images", where.parent / "images", where.parent.parent / "images", path.parent / "images"]
    for folder in tried:
        if (folder / name).is_file():
            return folder
    raise FileNotFoundError(f"{path / 'images' / name} is missing; put the pictures that the model registers into {path / 'images'}")


def _beside(file: Path, registered: tuple[Path, ...]) -> str:
    """A hint to what a missing picture may be called; "" where there is nothing like it but other numbers of the same series."""
    there = set(file.parent.iterdir()) if file.parent.is_dir() else set()
    series = re.sub(r"\d", "", file.name)
    return nearest(file.name, [p.name for p in there.difference(registered) if re.sub(r"\d", "", p.name) != series])


def _tell_masked(files: list[Path], masks: Path) -> None:
    """Say where masks in a folder, as COLMAP takes them, or transparent pixels are to hide something, which they do not here."""
    masking = [masks] * masks.is_dir()
    for file in files:
        with opened(file, str(file), FETCH) as picture:
            if picture.has_transparency_data and np.asarray(picture.convert("RGBA"))[..., 3].min() < 255:
                masking.append(file)
    for name in masking:
        print(f"{name} masks a part of the pictures, which is not heeded: all that they show is fitted", file=sys.stderr)


def _check_pictures(path: Path, where: Path, files: tuple[Path, ...], found: ModelCamera) -> None:
    """ValueError where a picture is of another size than its camera in the model in `where`, or COLMAP, which does not ask their EXIF data,
    took it as it is stored, and this says that is not upright: up and the ground would be sought to the side."""
    for file in files:
        with opened(file, str(file), FETCH) as picture:
            turned, (width, height) = is_turned(picture), picture.size
        if turned:
            fix = "turn them and make the model anew, or, if they are upright as stored, take the orientation out of their EXIF data"
            fix = "delete it to begin again" if path.suffix == WORKSPACE else fix
            raise ValueError(f"{path} was made of photos as they are stored, and {file.name} is not stored upright; {fix}")
        if (width, height) != (found.width, found.height):
            fix = f"put the pictures that the model was made of into {file.parent}, or make a model of these"
            taken = f"{file} is {width}x{height}, but the model in {where} has a camera of {found.width}x{found.height}"
            raise ValueError(f"{taken}; {fix}")
