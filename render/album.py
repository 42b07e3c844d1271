"""The photos that a scene was made from, kept in its folder as `photos/<camera>/<microseconds>.jpg`: references need no recording.

A scene that was moved to another machine, or whose recording is gone, still has them; one without, as of old, simply has no references.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from render.references import References, Shot
from render.video import write_image
from scenes.atomic import atomic_folder
from scenes.files import Dropping
from scenes.pictures import opened, rgb_of
from scenes.scene import Scene
from scenes.usd.scene import load_recorded

FOLDER = "photos"


def keep_photos(folder: Path, photos: Iterable[tuple[str, int, torch.Tensor]]) -> None:
    """Write camera, moment by the scene's clock and picture `[H, W, 3]` in 0..1 of each photo to a scene's folder, all or none."""
    with atomic_folder(folder / FOLDER, replace=True) as album:
        for camera, time_us, rgb in photos:
            (album / camera).mkdir(exist_ok=True)
            write_image(album / camera / f"{time_us}.jpg", rgb)


def references_of(folder: Path, scene: Scene) -> References | None:
    """The references of a `scene` that was loaded from a folder, and perhaps changed since; None where neither it nor an asset in it has
    photos."""
    shots = shots_in(folder, scene)
    if not shots and not any(actor.asset.photos for actor in scene.actors):
        return None
    device = scene.background.gaussians.means.device
    recorded = load_recorded(folder, Dropping()).to(device) if shots else scene
    return References(shots, recorded, scene)


def shots_in(folder: Path, scene: Scene) -> list[Shot]:
    """The photos that the folder of a `scene` keeps, each camera's in the order of time."""
    return [
        Shot(scene.camera(name, time_us), partial(_read, folder / FOLDER / name / f"{time_us}.jpg"))
        for name in scene.rig
        for time_us in sorted(int(file.stem) for file in (folder / FOLDER / name).glob("*.jpg") if re.fullmatch(r"-?\d+", file.stem))
    ]  # of a clock that begins at 0 a camera may turn out to be early


def _read(file: Path, width: int, height: int) -> np.ndarray:
    with opened(file, str(file), "remove it, and the photo is done without") as stored:
        picture = rgb_of(stored)
    return np.asarray(picture if picture.size == (width, height) else picture.resize((width, height), Image.Resampling.BOX))
