"""Corrects the path of a posed drive without lidar whose pictures do not agree by its recorded poses.

Poses by GPS jitter by centimetres from picture to picture (KITTI), which is pixels on near surfaces, and splats of such pictures are
blurred. Features are matched between the pictures of one camera, and poses and points are optimised together (bundle adjustment), with the
recorded positions as priors: far apart, where pictures share nothing, these hold.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

from recon.log import Log
from recon.registration.corrected import MOVED, as_corrected
from recon.sfm.posed import AHEAD, Posed, adjust, picture_name
from scenes.poses import inverse

SPREAD = 0.1
"""Standard deviation in metres of recorded positions."""

WORTH = 0.8
"""Reprojection error after the adjustment, as a part of that before, up to which corrections are made."""

FARTHEST = 1.0
"""Metres that a camera is moved at most: pictures of little but moving objects may fit anywhere."""

FEWEST = 8
"""Pictures without which nothing is corrected."""


def adjusted(log: Log, name: str, span_us: tuple[int, int], size: tuple[int, int]) -> Log:
    """The log with its body's path and cameras moved to where the pictures of the camera `name` in a span meet; as it is where they do
    already, and where too few show the same. size: width and height at which they are looked at.

    All pictures of the span count, also those that a fit holds out, as where structure from motion has found the poses. Corrections are
    interpolated between them. ValueError for a lens that COLMAP does not have.
    """
    camera = log.camera(name)
    chosen = [i for i, t in enumerate(camera.times_us.tolist()) if span_us[0] <= t <= span_us[1]]
    if len(chosen) < FEWEST:
        return log
    names = [picture_name(name, i) for i in chosen]
    given = inverse(camera.world_from_cam[chosen]).numpy()
    pairs = [(names[k], names[k + ahead]) for ahead in AHEAD for k in range(len(names) - ahead)]
    with tempfile.TemporaryDirectory() as folder:
        pictures = ((name, i, camera.image(i, *size)) for i in chosen)
        found, before, after = adjust(Posed.written(Path(folder), log, pictures, pairs), SPREAD)
    known = [k for k, file in enumerate(names) if file in found]
    if len(known) < FEWEST or after > WORTH * before:
        return log
    better = np.linalg.inv(np.stack([found[names[k]] for k in known]))
    moves = better @ given[known]
    if np.linalg.norm(better[:, :3, 3] - np.linalg.inv(given[known])[:, :3, 3], axis=1).max() > FARTHEST:
        return log
    print(f"{log.path}: its pictures meet within {before:.2f} pixels by its recorded poses, and {after:.2f} corrected", file=sys.stderr)
    path = {"times_us": camera.times_us[[chosen[k] for k in known]].tolist(), "poses": torch.from_numpy(moves).flatten(1).tolist()}
    return as_corrected(log, {MOVED: path})
