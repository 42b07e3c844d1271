"""Points of a drive that has poses but no lidar: features followed from picture to picture, triangulated at the recorded poses."""

from __future__ import annotations

import tempfile
from itertools import combinations
from pathlib import Path

import numpy as np

from recon.log import Log, SparsePoints
from recon.sfm.posed import AHEAD, Posed, picture_name, triangulate
from recon.views.frames import Frames
from recon.views.view import View

TOGETHER_US = 25_000
"""Pictures of two cameras that were taken so near each other are matched, too."""


def triangulated(log: Log, frames: Frames) -> SparsePoints:
    """The points `[N, 3]`, in the log's world, that the training pictures of `frames` show, at the poses that the log gives them.

    Rolling shutters count as global ones. ValueError for lenses that COLMAP does not have.
    """
    views = sorted(frames.training(), key=lambda v: (v.camera, v.time_us))
    names = [picture_name(frames.names[v.camera], v.index) for v in views]
    pairs = [(names[i], names[j]) for i, j in matched(views)]
    with tempfile.TemporaryDirectory() as folder:
        pictures = ((frames.names[v.camera], v.index, v.image.numpy()) for v in views)
        xyz, shown = triangulate(Posed.written(Path(folder), log, pictures, pairs))
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
