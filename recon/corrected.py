"""What was found wrong with a recording, put right: all that it knows of the world moved along a corrected path, and cameras up or down.

A log and the scenes fitted to it say in their `meta` what was corrected, so that it can be done again to the recording as it is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch

from recon.log import LidarPoints, Log, LogCamera, Sweep, Track
from scenes.trajectory import Trajectory

MOVED = "path_correction"
"""In `meta`: by which poses, at which times, the recorded world was moved."""

RAISED = "camera_heights"
"""In `meta`: by how many metres cameras, by name, stand higher above the road than recorded."""


def as_corrected(log: Log, meta: Mapping) -> Log:
    """A log as recorded, put right as the `meta` of a log or scene says, and saying so too; as it is where nothing was."""
    path, heights = meta.get(MOVED), meta.get(RAISED)
    if path is not None:
        poses = torch.tensor(path["poses"], dtype=torch.float64).view(-1, 4, 4)
        log = moved(replace(log, meta={**log.meta, MOVED: path}), Trajectory(torch.tensor(path["times_us"]), poses))
    if heights is not None:
        log = raised(replace(log, meta={**log.meta, RAISED: heights}), heights)
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


def raised(log: Log, heights: Mapping[str, float]) -> Log:
    """The log with cameras, by name, so many metres higher, along the body's own axis. Names that it has not are passed over."""

    def camera(c: LogCamera) -> LogCamera:
        poses = c.world_from_cam.clone()
        poses[:, :3, 3] += heights[c.name] * log.ego.near_each(c.times_us)[:, :3, 2]
        return replace(c, world_from_cam=poses)

    return replace(log, cameras={name: camera(c) if name in heights else c for name, c in log.cameras.items()})
