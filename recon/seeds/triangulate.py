"""Points of a drive that has poses but no lidar: features followed from picture to picture, triangulated at the recorded poses."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from itertools import combinations
from pathlib import Path

import numpy as np
from PIL import Image

from recon.frames import Frames
from recon.log import Log, SparsePoints
from recon.readers.colmap import colmap_lens
from recon.readers.sfm import Posed, triangulate
from recon.view import View
from scenes.poses import inverse

AHEAD = (1, 2, 4, 8)
"""By how many pictures of its camera those that are matched follow each other: the near ones look alike, the far ones tell depth."""

TOGETHER_US = 25_000
"""Pictures of two cameras that were taken so near each other are matched, too."""


def triangulated(log: Log, frames: Frames) -> SparsePoints:
    """The points `[N, 3]`, in the log's world, that the training pictures of `frames` show, at the poses that the log gives them.

    Rolling shutters count as global ones. ValueError for lenses that COLMAP has not.
    """
    views = sorted(frames.training(), key=lambda v: (v.camera, v.time_us))
    names = [picture_name(frames.names[v.camera], v.index) for v in views]
    pairs = [(names[i], names[j]) for i, j in matched(views)]
    with tempfile.TemporaryDirectory() as folder:
        pictures = ((frames.names[v.camera], v.index, v.image.numpy()) for v in views)
        xyz, shown = triangulate(posed(Path(folder), log, pictures, pairs))
    seen = {camera: [np.zeros(0, np.int64)] * len(log.camera(camera)) for camera in frames.names}
    for view, name in zip(views, names, strict=True):
        seen[frames.names[view.camera]][view.index] = shown[name]
    return SparsePoints(xyz, {camera: tuple(of) for camera, of in seen.items()})


def picture_name(camera: str, index: int) -> str:
    """What a camera's picture is called where COLMAP looks at it."""
    return f"{camera}/{index:06d}.png"


def posed(folder: Path, log: Log, pictures: Iterable[tuple[str, int, np.ndarray]], pairs: list[tuple[str, str]]) -> Posed:
    """Pictures uint8 `[H, W, 3]` of cameras at indices, written to a folder, with the log's lenses at their size and poses. pairs: by
    `picture_name`. ValueError for lenses that COLMAP has not."""
    lenses, poses = {}, {}
    for name, index, image in pictures:
        camera, file = log.camera(name).camera(index, image.shape[1], image.shape[0]), folder / "images" / picture_name(name, index)
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(file, compress_level=1)
        lenses[name] = colmap_lens(camera.lens, log.path)
        poses[picture_name(name, index)] = inverse(camera.world_from_cam).numpy()
    return Posed(folder, lenses, poses, pairs)


def matched(views: list[View]) -> list[tuple[int, int]]:
    """Which of the views, sorted by camera and time, are matched: those of a camera that are `AHEAD`, and those of a moment."""
    return [
        (i, j)
        for (i, one), (j, other) in combinations(enumerate(views), 2)
        if (j - i in AHEAD if one.camera == other.camera else abs(other.time_us - one.time_us) <= TOGETHER_US)
    ]
