"""COLMAP models as plain arrays: cameras, registered pictures and points."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from recon.readers.one_lens import is_one_a_picture, share_lenses
from recon.sfm.colmap import MISSING, pycolmap, visible_points

PARTS = ("cameras", "images", "points3D")


@dataclass(frozen=True)
class ModelCamera:
    """A calibrated camera: COLMAP's name of its lens model, size in pixels, and that model's parameters in COLMAP's order."""

    lens: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ModelImage:
    """A registered picture: its name below the folder of images, camera, frame of the rig, `cam_from_world` float64 `[4, 4]`, and which
    points it shows, int64 `[P]`."""

    name: str
    camera: int
    frame: int
    cam_from_world: np.ndarray
    points: np.ndarray


@dataclass(frozen=True)
class Model:
    """What structure from motion found, in its own units: cameras by id, pictures in the order of their names, points `[N, 3]`;
    `rigid` where its rigs hold several cameras, so that pictures of one frame were taken at one moment."""

    cameras: dict[int, ModelCamera]
    images: tuple[ModelImage, ...]
    xyz: np.ndarray
    rigid: bool


def is_model(folder: Path) -> bool:
    """Whether a folder holds COLMAP's files, binary or text."""
    return any(all((folder / f"{part}{end}").is_file() for part in PARTS[:2]) for end in (".bin", ".txt"))


def read_model(folder: Path) -> Model:
    """The COLMAP model in `folder`. ValueError where a file is missing, corrupt, or no picture is registered."""
    lost = {end: [p for p in PARTS if not (folder / f"{p}{end}").is_file()] for end in (".bin", ".txt")}
    if all(lost.values()):  # a whole model of one kind is read whatever lies beside it
        end = min(lost, key=lambda end: len(lost[end]))
        raise FileNotFoundError(f"{folder / f'{lost[end][0]}{end}'} is missing; a COLMAP model has {', '.join(p + end for p in PARTS)}")
    try:
        colmap = pycolmap()
        found = colmap.Reconstruction()
        if lost[".bin"]:
            found.read_text(str(folder))
            _name_whole(found, folder / "images.txt")
        else:
            found.read_binary(str(folder))
    except (RuntimeError, ValueError, LookupError, MemoryError) as problem:
        if MISSING in str(problem):
            raise
        raise ValueError(f"{folder} is not a valid COLMAP model ({_first_line(problem)}); export it again") from None
    if is_one_a_picture(found):
        found = share_lenses(colmap, found, folder)
    place = {key: i for i, key in enumerate(sorted(found.points3D))}
    xyz = np.array([found.points3D[key].xyz for key in place], dtype=np.float64).reshape(-1, 3)
    cameras = {key: ModelCamera(c.model_name, c.width, c.height, tuple(map(float, c.params))) for key, c in found.cameras.items()}
    images = []
    for image in sorted((i for i in found.images.values() if i.has_pose), key=lambda i: i.name):
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        images.append(ModelImage(image.name, image.camera_id, image.frame_id, pose, visible_points(image, place)))
    if not images:
        raise ValueError(f"{folder} registers no picture; COLMAP found no pose, so there is nothing to reconstruct from")
    twice = next((a.name for a, b in pairwise(images) if a.name == b.name), None)
    if twice is not None:
        raise ValueError(f"{folder} registers two pictures as {twice}; run COLMAP's mapper again")
    values = np.concatenate([xyz.ravel(), *(i.cam_from_world.ravel() for i in images)])
    if not np.isfinite(values).all():
        raise ValueError(f"{folder} holds a pose or a point that is not finite; run COLMAP's mapper again")
    return Model(cameras, tuple(images), xyz, any(len(rig.non_ref_sensors) > 0 for rig in found.rigs.values()))


def _name_whole(found, listed: Path) -> None:
    """Give the pictures of a text model their names as they are listed: COLMAP itself ends them at their first space."""
    lines = iter(listed.read_text(encoding="utf-8").split("\n"))
    for line in lines:
        words = line.split(maxsplit=9)
        if words and not words[0].startswith("#"):
            found.images[int(words[0])].name = words[9].strip()
            next(lines, None)  # what the picture shows


def _first_line(problem: Exception) -> str:
    return (str(problem).strip().splitlines() or ["it does not parse"])[-1][:160]
