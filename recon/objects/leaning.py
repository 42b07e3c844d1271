"""Boxes that lean as the road under them does.

Annotators, and those who follow points of lidar, draw boxes upright. On a hill such a box holds the road before the car and leaves its
wheels behind out, so that a piece of road drives along with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from recon.ground import estimate_ground, shown_ground
from recon.log import Log, Sweep, Track
from recon.objects.tracks import LIMBED
from scenes.ground import Ground
from scenes.poses import yaw_of
from scenes.spread import spread
from scenes.standing import leaning_pose, plane_under

LOOKS, THIN = 24, 20_000
"""Sweeps, spread over the drive, and about as many points of each that tell where the ground is."""

UPRIGHT = math.cos(math.radians(1))
"""Cosine of a box's own tilt from which on a log tells how it leans."""

STEEP, OFTEN = 0.04, 0.75
"""Slope of the road from which on a track's boxes lean, and the part of its boxes that may be where it is less: roads are higher in their
middle by half of that, and kerbs are short."""

KNOWN, TOLD = 0.5, 0.25
"""Part of what is under a box that must be known to be ground, for its slope to be told, and of a track's boxes of which it must be."""

OFF = 1.0
"""Metres that a box's lower side may be off the ground at most, for it to stand there."""


def leaning(log: Log, sweeps: Sequence[Sweep]) -> Log:
    """The log with boxes of what rolls leaning as the ground that `sweeps` show does, where that is steep and the boxes are upright."""
    if not sweeps or not any(t.moving and t.label not in LIMBED for t in log.tracks):
        return log
    read = [s.read().xyz for s in spread(sweeps, LOOKS)]
    points = np.concatenate([xyz[:: max(1, len(xyz) // THIN)] for xyz in read])
    ground = estimate_ground(points, log.ego.within((sweeps[0].time_us, sweeps[-1].time_us)))
    shown = replace(ground, heights=(shown_ground(points, ground) > 0).float())
    return replace(log, tracks=tuple(_leaning(track, ground, shown) for track in log.tracks))


def _leaning(track: Track, ground: Ground, shown: Ground) -> Track:
    """A track whose boxes lie as the ground does; `shown` is 1 where that is known. About their middles, which points tell; where they
    then reach under the ground, since an upright box around a leaning car is too high, they end there."""
    poses, size = track.world_from_box, torch.from_numpy(track.size)
    if not track.moving or track.label in LIMBED or (poses[:, 2, 2] < UPRIGHT).any():
        return track
    at, headings = poses[:, :2, 3], yaw_of(poses)
    height, rise, bank = plane_under(ground.height, at, headings, size)
    known = (plane_under(shown.height, at, headings, size)[0] >= KNOWN) & ((height - poses[:, 2, 3]).abs() < OFF)
    steep = torch.hypot(rise, bank)[known]
    if known.double().mean() < TOLD or steep.quantile(OFTEN) < STEEP:
        return track
    each, told = np.arange(len(poses)), np.flatnonzero(known)
    rise, bank = (torch.from_numpy(np.interp(each, told, slope.numpy()[told])) for slope in (rise, bank))
    middles = poses[:, :3, 3] + poses[:, :3, 2] * track.size[2] / 2
    leant = leaning_pose(middles, headings, rise, bank)
    leant[:, :3, 3] -= leant[:, :3, 2] * track.size[2] / 2
    under = (ground.height(leant[:, :2, 3]) - leant[:, 2, 3]) * leant[:, 2, 2]
    cut = float(under[known].median().clamp(0, track.size[2] / 2))
    leant[:, :3, 3] += cut * leant[:, :3, 2]
    return replace(track, world_from_box=leant, size=track.size - np.array([0.0, 0.0, cut]))
