"""A log without what would spoil all of it: pictures from outside the body's path in time, or from where their camera cannot have been,
are left out; a path that leaps is refused."""

from __future__ import annotations

import sys
from dataclasses import replace

import torch

from recon.log import Log, LogCamera
from scenes.poses import inverse, nearest_rotation

AWAY, TURNED, BEYOND = 2.0, 20.0, 10.0
"""Metres and degrees from a camera's usual place on the body from which on a pose is astray, if it is so many times as far as most are."""

LEAP, FASTEST, USUAL = 20.0, 100.0, 20.0
"""Metres between two poses, metres a second, and times the usual speed, all of which a path leaps by."""


def sound(log: Log) -> Log:
    """The log without pictures of times that the body's path does not cover, and without those whose camera's pose differs from where it
    is otherwise mounted; stderr tells of each camera how many. ValueError where no picture is left."""
    cameras, seen = {}, dict(log.points.seen) if log.points else {}
    for name, camera in log.cameras.items():
        kept = log.ego.covers_each(camera.times_us)
        if not kept.all():
            _tell(log, camera, ~kept, "the body's path does not last as long")
        away = torch.zeros(len(camera))
        away[kept] = _astray(inverse(log.ego.at_each(camera.times_us[kept])) @ camera.world_from_cam[kept])
        if (away > 0).any():
            _tell(log, camera, away > 0, f"by their poses the camera was up to {float(away.max()):.3g} m from its place on the body")
            kept &= away == 0
        if kept.all():
            cameras[name] = camera
        elif kept.any():
            index = kept.nonzero()[:, 0].tolist()
            files = tuple(camera.files[i] for i in index)
            cameras[name] = replace(camera, files=files, times_us=camera.times_us[kept], world_from_cam=camera.world_from_cam[kept])
            if name in seen:
                seen[name] = tuple(seen[name][i] for i in index)
    if not cameras:
        raise ValueError(f"{log.path}: no camera took a picture while the body's path is known; check the clocks of cameras and poses")
    points = replace(log.points, seen=seen) if log.points else None
    return replace(log, cameras=cameras, front=tuple(n for n in log.front if n in cameras), points=points)


def check_path(log: Log, span_us: tuple[int, int]) -> None:
    """ValueError where the body's path leaps within a span of time, naming when. That of a COLMAP model may: no clock told its times, and
    photos may be of two places."""
    path = log.ego.within(span_us)
    if len(path) < 3 or "world_from_model" in log.meta:
        return
    steps = path.world_from_body[:, :3, 3].diff(dim=0).norm(dim=1)
    speeds = steps / path.times_us.diff() * 1e6
    leaps = (steps > LEAP) & (speeds > FASTEST) & (speeds > USUAL * speeds.median())
    if leaps.any():
        i = int(leaps.nonzero()[0])
        begun = next(iter(log.cameras.values())).times_us[0]
        when = float(path.times_us[i] - begun) / 1e6
        fix = "correct that pose, or leave it out with --start and --duration"
        raise ValueError(f"{log.path}: the body's path leaps by {float(steps[i]):.0f} m {when:.2f} s into the drive; {fix}")


def _astray(mounts: torch.Tensor) -> torch.Tensor:
    """How far each of `body_from_cam` `[F, 4, 4]` is from the usual one, metres `[F]`; 0 where it is not astray."""
    if len(mounts) < 3:
        return torch.zeros(len(mounts))
    usual = mounts.median(0).values
    off = (mounts[:, :3, 3] - usual[:3, 3]).norm(dim=1)
    turn = mounts[:, :3, :3] @ nearest_rotation(usual[:3, :3]).T
    angle = torch.rad2deg(torch.acos(((turn.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)))
    astray = (off > AWAY) & (off > BEYOND * off.median()) | (angle > TURNED) & (angle > BEYOND * angle.median())
    return torch.where(astray, off.clamp_min(1e-3), 0.0).float()


def _tell(log: Log, camera: LogCamera, wrong: torch.Tensor, why: str) -> None:
    first = camera.files[int(wrong.nonzero()[0])]
    count = f"{int(wrong.sum())} of {len(camera)} pictures of {camera.name}"
    print(f"{log.path}: {count} are left out, the first of them {first}: {why}", file=sys.stderr)
