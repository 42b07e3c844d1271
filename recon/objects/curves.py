"""Ways that curve between boxes: nuScenes' are half a second apart, in which a car that turns leaves the straight line by a decimetre."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.interpolate import CubicHermiteSpline

from recon.log import Track

APART_US = 750_000
"""Between a track's boxes at most, for it to be known between them: nuScenes annotates every half second."""

STRAIGHT_US, STEP_US = 250_000, 100_000
"""Between two boxes at most, for what moves to go straight from one to the other; and else about how far apart the poses on its way are."""


def curved(track: Track) -> Track:
    """A moving track with poses about `STEP_US` apart where its boxes are more than `STRAIGHT_US` apart, `APART_US` at most: on the cubic
    curve through its boxes along the parabolas through each and those beside it (Catmull and Rom 1974), turning evenly. It exists as long
    as before, half a step beyond its first and its last box."""
    times = track.times_us
    if len(times) < 3 or not track.moving:
        return track
    steps = np.diff(times)
    parts = np.where((steps > STRAIGHT_US) & (steps <= APART_US), steps // STEP_US // 2 * 2 + 1, 1)  # odd, for the ends
    between = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(times[:-1], times[1:], parts, strict=True)]
    before, after = (step / n * np.arange(1, n // 2 + 1) for step, n in ((steps[0], parts[0]), (steps[-1], parts[-1])))
    fine = np.concatenate([(times[0] - before)[::-1], *between, [times[-1]], times[-1] + after]).round().astype(np.int64)
    if len(fine) == len(times):
        return track
    seconds, places = (times - times[0]) / 1e6, track.world_from_box[:, :3, 3].numpy()
    ways = np.gradient(places, seconds, axis=0, edge_order=2)
    at = (fine - times[0]) / 1e6
    poses = track.trajectory().near_each(torch.from_numpy(fine)).clone()
    poses[:, :3, 3] = torch.from_numpy(CubicHermiteSpline(seconds, places, ways)(at.clip(0, seconds[-1])))
    poses[:, :3, 3] += torch.from_numpy(np.minimum(at, 0)[:, None] * ways[0] + np.maximum(at - seconds[-1], 0)[:, None] * ways[-1])
    sensor = np.where(np.isin(fine, times), track.sensor[np.searchsorted(times, fine).clip(max=len(times) - 1)], -1)
    return replace(track, times_us=fine, world_from_box=poses, sensor=sensor)
