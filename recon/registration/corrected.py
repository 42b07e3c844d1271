"""Applies corrections to a recording: everything in its world moves along with a corrected path, and cameras move on the car.

A log and the scenes fitted to it keep the corrections in their `meta`, so that they can be applied to the recording again when it is read
anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from recon.log import LidarPoints, Log, LogCamera, Sweep, Track
from scenes.poses import inverse, small_poses
from scenes.trajectory import Trajectory

MOVED = "path_correction"
"""In `meta`: by which poses, at which times, the recorded world was moved."""

REMOUNTED = "mount_corrections"
"""In `meta`: of cameras, by name, by how many metres they stand higher, and how many radians they look farther up, than recorded."""

TURNED = "mount_turns"
"""In `meta`: of cameras, by name, by which small motion, in their own frame, they are fixed to the car otherwise than recorded, and by how
many seconds they took their pictures later: a rotation vector in radians, metres, and that."""

KINDS = (MOVED, TURNED, REMOUNTED)


def as_corrected(log: Log, meta: Mapping) -> Log:
    """A log as recorded, put right as the `meta` of a log or scene says, and saying so too; as it is where nothing was."""
    path, turns, mounts = (meta.get(kind) for kind in KINDS)
    if path is not None:
        poses = torch.tensor(path["poses"], dtype=torch.float64).view(-1, 4, 4)
        log = moved(replace(log, meta={**log.meta, MOVED: path}), Trajectory(torch.tensor(path["times_us"]), poses))
    if turns is not None:
        log = turned(replace(log, meta={**log.meta, TURNED: turns}), turns)
    if mounts is not None:
        log = remounted(replace(log, meta={**log.meta, REMOUNTED: mounts}), mounts)
    return log


def moved(log: Log, correction: Trajectory) -> Log:
    """The log with all that it knows of the world moved by a correction that depends on the time."""

    def at(times_us: torch.Tensor) -> torch.Tensor:
        return correction.near_each(times_us)

    def camera(c: LogCamera) -> LogCamera:
        return replace(c, world_from_cam=at(c.times_us) @ c.world_from_cam)

    def sweep(s: Sweep) -> Sweep:
        def read() -> LidarPoints:
            points, pose = s.read(), correction.near(s.time_us).numpy()
            return replace(points, xyz=points.xyz @ pose[:3, :3].T + pose[:3, 3])

        return replace(s, read=read)

    def track(t: Track) -> Track:
        return replace(t, world_from_box=at(torch.from_numpy(t.times_us)) @ t.world_from_box)

    ego = replace(log.ego, world_from_body=at(log.ego.times_us) @ log.ego.world_from_body)
    cameras = {name: camera(c) for name, c in log.cameras.items()}
    return replace(log, ego=ego, cameras=cameras, sweeps=tuple(map(sweep, log.sweeps)), tracks=tuple(map(track, log.tracks)))


def turned(log: Log, mounts: Mapping[str, Sequence[float]]) -> Log:
    """The log with cameras, by name, moved by a small motion in their own frame and to where they were so many seconds later, `[7]`. Names
    that it has not are passed over."""

    def camera(c: LogCamera) -> LogCamera:
        *motion, seconds = mounts[c.name]
        times = c.times_us + round(seconds * 1e6)
        along = log.ego.near_each(times) @ inverse(log.ego.near_each(c.times_us)) if seconds else torch.eye(4, dtype=torch.float64)
        return replace(c, times_us=times, world_from_cam=along @ c.world_from_cam @ small_poses(torch.tensor(motion, dtype=torch.float64)))

    return replace(log, cameras={name: camera(c) if name in mounts else c for name, c in log.cameras.items()})


def remounted(log: Log, mounts: Mapping[str, tuple[float, float]]) -> Log:
    """The log with cameras, by name, so many metres higher, along the body's own axis, and so many radians tilted up. Names that it has not
    are passed over."""

    def camera(c: LogCamera) -> LogCamera:
        metres, radians = mounts[c.name]
        poses = c.world_from_cam @ small_poses(torch.tensor([radians, 0, 0, 0, 0, 0]))
        poses[:, :3, 3] += metres * log.ego.near_each(c.times_us)[:, :3, 2]
        return replace(c, world_from_cam=poses)

    return replace(log, cameras={name: camera(c) if name in mounts else c for name, c in log.cameras.items()})
