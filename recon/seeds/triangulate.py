"""Points of a drive that has poses but no lidar: features followed from picture to picture, triangulated at the recorded poses."""

from __future__ import annotations

import tempfile
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
    names = [f"{frames.names[v.camera]}/{v.index:06d}.png" for v in views]
    with tempfile.TemporaryDirectory() as folder:
        lenses, poses = {}, {}
        for view, name in zip(views, names, strict=True):
            camera = log.camera(frames.names[view.camera]).camera(view.index, frames.width, frames.height)
            file = Path(folder, "images", name)
            file.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(view.image.numpy()).save(file, compress_level=1)
            lenses[file.parent.name] = colmap_lens(camera.lens, log.path)
            poses[name] = inverse(camera.world_from_cam).numpy()
        pairs = [(names[i], names[j]) for i, j in matched(views)]
        xyz, shown = triangulate(Posed(Path(folder), lenses, poses, pairs))
    seen = {camera: [np.zeros(0, np.int64)] * len(log.camera(camera)) for camera in frames.names}
    for view, name in zip(views, names, strict=True):
        seen[frames.names[view.camera]][view.index] = shown[name]
    return SparsePoints(xyz, {camera: tuple(of) for camera, of in seen.items()})


def matched(views: list[View]) -> list[tuple[int, int]]:
    """Which of the views, sorted by camera and time, are matched: those of a camera that are `AHEAD`, and those of a moment."""
    return [
        (i, j)
        for (i, one), (j, other) in combinations(enumerate(views), 2)
        if (j - i in AHEAD if one.camera == other.camera else abs(other.time_us - one.time_us) <= TOGETHER_US)
    ]
