"""The path of the body from the recorded poses of its first camera."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch

from recon.log import Log
from recon.views.frames import Frames
from scenes.camera import RigCamera
from scenes.poses import interpolate, inverse
from scenes.trajectory import Trajectory

LACKING = 1.5
"""Length of a gap between the first camera's pictures, in usual intervals, from which on pictures are missing in it."""


def body_path(log: Log, frames: Frames, rig: dict[str, RigCamera]) -> Trajectory:
    """The body at the first camera's moments, from its recorded poses, one step longer at either end.

    Camera poses are recorded closer to the pictures than the lidar's are. Where the camera lacks some, the body goes as the log has it, and
    no shortcut: other cameras took theirs there.
    """
    name = frames.names[0]
    camera, back = log.camera(name), inverse(rig[name].body_from_cam)
    views = [v for v in frames.views if v.camera == 0]
    times = [v.time_us for v in views]
    poses = [camera.world_from_cam[v.index] @ back for v in views]
    times, poses = _without_gaps(log.ego, times, poses)
    if len(times) > 1:
        times = [2 * times[0] - times[1], *times, 2 * times[-1] - times[-2]]
        poses = [interpolate(poses[0], poses[1], -1.0), *poses, interpolate(poses[-2], poses[-1], 2.0)]
    return Trajectory(torch.tensor(times), torch.stack(poses))


def _without_gaps(ego: Trajectory, times: list[int], poses: list[torch.Tensor]) -> tuple[list[int], list[torch.Tensor]]:
    """Times and a body's poses with those of its path `ego`, where it has any, in steps of which a usual one is less than `LACKING`; moved
    as they are before and after the step."""
    if len(times) < 3:
        return times, poses
    usual = float(np.median(np.diff(times)))
    off = inverse(ego.near_each(torch.tensor(times))) @ torch.stack(poses)
    whole_times, whole_poses = times[:1], poses[:1]
    for i, (first, last) in enumerate(pairwise(times)):
        between = np.linspace(first, last, round((last - first) / usual) + 1)[1:-1].round().astype(np.int64)
        if last - first > LACKING * usual and ((ego.times_us > first) & (ego.times_us < last)).any():
            moved = [interpolate(off[i], off[i + 1], (t - first) / (last - first)) for t in between.tolist()]
            whole_times += between.tolist()
            whole_poses += list(ego.near_each(torch.from_numpy(between)) @ torch.stack(moved))
        whole_times.append(last)
        whole_poses.append(poses[i + 1])
    return whole_times, whole_poses
