"""A drive of which something is recorded otherwise than it was: its world, clock, poses, lenses or boxes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from recon.log import LidarPoints, Log, LogCamera, Sweep, Track, lengthened
from recon.objects.tracks import named
from recon.registration.align import about
from recon.registration.corrected import moved, turned
from scenes.lenses import Lens
from scenes.poses import small_poses, translation, yaw
from scenes.trajectory import Trajectory
from tests.bench.changed_pictures import repainted
from tests.bench.changes import change

TO_OTHER_SIDE = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
"""Left and right swapped: of axes that look forward, left and up."""

IN_PICTURE = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0], dtype=torch.float64))
"""The same of a camera's, which look right, down and forward."""

TURNS = ("p2", "s1", "s2", "d", "e")
"""What of a lens changes its sign in a mirror, beside `cx`."""


@change()
def elsewhere(log: Log) -> Log:
    """Turned by 200 degrees, 58 km away, 300 m up."""
    there = translation(50_000.0, 30_000.0, 300.0) @ yaw(np.radians(200))
    return moved(log, Trajectory(torch.tensor([0]), there[None]))


@change()
def mirrored(log: Log) -> Log:
    """Left-hand traffic; aside is to the other side."""
    over = np.array([1.0, -1.0, 1.0])

    def camera(c: LogCamera) -> LogCamera:
        ego_mask = None if c.ego_mask is None else c.ego_mask[:, ::-1]
        readout_us = -c.readout_us if c.shutter == "columns" else c.readout_us
        lens, poses = _mirrored_lens(c.lens, c.width), TO_OTHER_SIDE @ c.world_from_cam @ IN_PICTURE
        return replace(c, lens=lens, world_from_cam=poses, ego_mask=ego_mask, readout_us=readout_us)

    def sweep(s: Sweep) -> Sweep:
        def read() -> LidarPoints:
            points = s.read()
            return replace(points, xyz=points.xyz * over)

        return replace(s, read=read)

    def poses(of: torch.Tensor) -> torch.Tensor:
        return TO_OTHER_SIDE @ of @ TO_OTHER_SIDE

    log = repainted(log, "mirrored", lambda picture, index: picture[:, ::-1])
    return replace(
        log,
        cameras={name: camera(c) for name, c in log.cameras.items()},
        sweeps=tuple(map(sweep, log.sweeps)),
        tracks=tuple(replace(t, world_from_box=poses(t.world_from_box)) for t in log.tracks),
        ego=replace(log.ego, world_from_body=poses(log.ego.world_from_body)),
        lidars={sensor: place * over for sensor, place in log.lidars.items()},
    )


def _mirrored_lens(lens: Lens, width: int) -> Lens:
    told = {name: getattr(lens, name) for name in ("cx", *TURNS) if hasattr(lens, name)}
    return replace(lens, **{name: width - value if name == "cx" else -value for name, value in told.items()})


@change()
def half_rate(log: Log) -> Log:
    """Every other picture, sweep and box: 5 a second."""
    return thinned(log, 2)


@change(clock=1 / 3)
def faster(log: Log) -> Log:
    """Every third picture, sweep and box, as ten a second: all goes three times as fast."""
    return stretched(thinned(log, 3), 1 / 3)


@change(clock=5)
def slower(log: Log) -> Log:
    """Each second as five: two pictures and sweeps a second, and all goes a fifth as fast."""
    return stretched(log, 5)


def thinned(log: Log, every: int) -> Log:
    """The drive with one of `every` pictures, sweeps, poses of its path, and boxes of these sweeps' moments."""
    path = log.ego.times_us[1:-1]  # readers put one more pose before and after those recorded

    def track(t: Track) -> Track:
        nearest = (torch.from_numpy(t.times_us)[:, None] - path).abs().argmin(1).numpy()
        return t.part(nearest % every == 0)

    ego = lengthened(path[::every].numpy(), log.ego.world_from_body[1:-1][::every])
    cameras = {name: c.part(slice(None, None, every)) for name, c in log.cameras.items()}
    sweeps = tuple(replace(s, index=s.index // every) for s in log.sweeps if s.index % every == 0)
    tracks = [t for t in map(track, log.tracks) if len(t.times_us)]
    return replace(log, ego=ego, cameras=cameras, sweeps=sweeps, tracks=named(tracks, ego))


def stretched(log: Log, factor: float) -> Log:
    """The drive with all times so many times as long after its first picture."""
    begun = int(next(iter(log.cameras.values())).times_us[0])

    def late(times_us: np.ndarray) -> np.ndarray:
        return begun + np.round((times_us - begun) * factor).astype(np.int64)

    def camera(c: LogCamera) -> LogCamera:
        return replace(c, times_us=torch.from_numpy(late(c.times_us.numpy())), readout_us=round(c.readout_us * factor))

    def sweep(s: Sweep) -> Sweep:
        def read() -> LidarPoints:
            points = s.read()
            return replace(points, times_us=late(points.times_us))

        return replace(s, time_us=int(late(np.array(s.time_us))), read=read)

    return replace(
        log,
        cameras={name: camera(c) for name, c in log.cameras.items()},
        sweeps=tuple(map(sweep, log.sweeps)),
        tracks=tuple(replace(t, times_us=late(t.times_us)) for t in log.tracks),
        ego=replace(log.ego, times_us=torch.from_numpy(late(log.ego.times_us.numpy()))),
    )


def _aside(log: Log, radians: float) -> Log:
    return turned(log, {name: (0.0, radians, 0.0, 0.0, 0.0, 0.0, 0.0) for name in log.cameras})


def _late(log: Log, seconds: float) -> Log:
    return turned(log, {name: (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, seconds) for name in log.cameras})


@change()
def camera_turned(log: Log) -> Log:
    """The camera turned aside by 5 mrad."""
    return _aside(log, 0.005)


@change()
def half_a_degree(log: Log) -> Log:
    """The camera turned aside by half a degree."""
    return _aside(log, np.radians(0.5))


@change()
def long_lens(log: Log) -> Log:
    """A focal length 1 % too long."""

    def lens(of: Lens) -> Lens:
        return replace(of, **{name: 1.01 * getattr(of, name) for name in ("fx", "fy")})

    return replace(log, cameras={name: replace(c, lens=lens(c.lens)) for name, c in log.cameras.items()})


@change()
def late_pictures(log: Log) -> Log:
    """Pictures dated 30 ms late."""
    return _late(log, 0.030)


@change()
def later_pictures(log: Log) -> Log:
    """Pictures dated 50 ms late."""
    return _late(log, 0.050)


@change(spoilt="boxes")
def late_boxes(log: Log) -> Log:
    """Boxes dated 50 ms late."""
    return replace(log, tracks=tuple(replace(t, times_us=t.times_us + 50_000) for t in log.tracks))


@change(spoilt="boxes")
def shaken_boxes(log: Log) -> Log:
    """Boxes off by 15 cm along both axes and 2 degrees, 5 % too large or small, three of ten left out."""
    chance = np.random.default_rng(0)

    def track(t: Track) -> Track:
        count = len(t.times_us)
        motions = np.zeros((count, 6))
        motions[:, 2], motions[:, 3:5] = chance.normal(0, np.radians(2), count), chance.normal(0, 0.15, (count, 2))
        size, kept = t.size * (1 + 0.05 * chance.choice([-1, 1])), chance.random(count) >= 0.3
        kept[chance.integers(count)] = True
        return replace(t, size=size, world_from_box=t.world_from_box @ small_poses(torch.from_numpy(motions))).part(kept)

    return replace(log, tracks=named([track(t) for t in log.tracks], log.ego))


@change(spoilt="path")
def shaken_path(log: Log) -> Log:
    """Each pose of the path, and all that lies along it, off by 5 cm and 3 mrad at random (standard deviations along each axis)."""
    body = log.ego.world_from_body
    off = np.random.default_rng(0).normal(0, 1, (len(body), 6)) * np.repeat([0.003, 0.05], 3)
    return moved(log, Trajectory(log.ego.times_us, about(body[:, :3, 3].numpy(), off)))
