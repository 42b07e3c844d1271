"""The waypoints of a CSV file in the world: where they go, and where what goes along them faces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch

from scenes.placement import FARTHEST, Waypoint, read_waypoints
from scenes.poses import yaw_of

STEP_US = 100_000
"""Between poses at most, so that what goes there follows the ground."""

LONGEST_US = 3_600_000_000
"""From the clip's first frame: no drive lasts longer, and each pose takes a look at the ground."""

SIDEWAYS = 30
"""Degrees from its way by which what goes may be turned: beyond, no wheel drives so."""

SLIDES = 0.5
"""Metres so from which it is told: what hardly moves shakes on the spot."""

SHAKES = 0.1
"""Metres that tell no direction: a recorded car that stands or creeps shakes by millimetres, tens of degrees from one row to the next."""


@dataclass(frozen=True)
class Way:
    """Times int64 `[T]`, world points `[T, 2]` and headings `[T]` in radians, counter-clockwise from the world's x."""

    times_us: torch.Tensor
    xy: torch.Tensor
    headings: torch.Tensor


def way_of(file: Path, world_from_body: torch.Tensor, start_us: int) -> Way:
    """The way that a CSV trajectory (`read_waypoints`) describes from a body's pose `[4, 4]` at a time, with poses between its rows at most
    STEP_US apart. ValueError where it is bad; FileNotFoundError."""
    points = read_waypoints(file)
    _check_near(file, points)
    t = torch.tensor([p.time_us for p in points], dtype=torch.float64)
    xy = torch.tensor([[p.x, p.y] for p in points], dtype=torch.float64)
    yaws = [p.yaw for p in points if p.yaw is not None]
    turn = _unwrapped(torch.tensor(yaws, dtype=torch.float64)) if yaws else _facing(xy)

    at = [torch.tensor([len(points) - 1.0], dtype=torch.float64)]
    for i, step in enumerate(t.diff().tolist()):
        count = math.ceil(step / STEP_US)
        at.insert(-1, i + torch.arange(count, dtype=torch.float64) / count)
    where = torch.cat(at)
    low = where.floor().long().clamp_max(len(points) - 2)
    u = where - low

    def between(values: torch.Tensor) -> torch.Tensor:
        return torch.lerp(values[low], values[low + 1], u if values.ndim == 1 else u[:, None])

    return Way(start_us + between(t).round().long(), ahead_and_left(world_from_body, between(xy)), yaw_of(world_from_body) + between(turn))


def ahead_and_left(world_from_body: torch.Tensor, xy: torch.Tensor) -> torch.Tensor:
    """World points `[N, 2]` of points forward and left of a body, level with the world: its pitch and roll do not tilt the street."""
    heading = yaw_of(world_from_body)
    forward = torch.stack([torch.cos(heading), torch.sin(heading)])
    left = torch.stack([-forward[1], forward[0]])
    return world_from_body[:2, 3] + xy[:, :1] * forward + xy[:, 1:] * left


def sliding_warning(name: str, way: Way, file: Path, start_us: int) -> list[str]:
    """What to tell of what goes sideways for `SLIDES` metres and more: a sentence, or nothing."""
    step = way.xy.diff(dim=0)
    along = step[:, 0] * way.headings[:-1].cos() + step[:, 1] * way.headings[:-1].sin()
    sideways = along.abs() < math.cos(math.radians(SIDEWAYS)) * step.norm(dim=1)
    if float(step[sideways].norm(dim=1).sum()) <= SLIDES:
        return []
    first = (int(way.times_us[int(sideways.nonzero()[0])]) - start_us) / 1e6
    where = f"{name} slides sideways {first:g}s after the clip's first frame"
    return [f"{where}; say in {file} by yaw_deg where it faces, or give more points where it turns"]


def _check_near(path: Path, points: list[Waypoint]) -> None:
    """ValueError where a trajectory's times are no seconds of a drive, or its places no metres of one."""
    far = max(points, key=lambda p: abs(p.time_us))
    if abs(far.time_us) > LONGEST_US:
        told = f"{path} has the time_s {far.time_us / 1e6:g}, which is more than an hour from the clip's first frame"
        raise ValueError(f"{told}; time_s counts seconds from there, no milliseconds, and not since 1970")
    name, metres = max((pair for p in points for pair in (("x_m", p.x), ("y_m", p.y))), key=lambda pair: abs(pair[1]))
    if abs(metres) > FARTHEST:
        told = f"{path} has the {name} {metres:g}, which is more than {FARTHEST / 1000:g} km from the car at the clip's first frame"
        raise ValueError(f"{told}; {name} counts metres from there, not coordinates of a map")


def _unwrapped(angles: torch.Tensor) -> torch.Tensor:
    """The same angles `[T]`, none farther than half a turn from the one before."""
    shorter = (angles.diff() + torch.pi) % (2 * torch.pi) - torch.pi
    return torch.cat([angles[:1], angles[0] + shorter.cumsum(0)])


def _facing(xy: torch.Tensor) -> torch.Tensor:
    """Where what goes along points `[T, 2]` faces at each, radians: by those that are `SHAKES` apart, and between them by the way gone."""
    before = [0]  # of each point the last that tells a direction
    for i in range(1, len(xy)):
        before.append(i if float((xy[i] - xy[before[-1]]).norm()) >= SHAKES else before[-1])
    after = [before[-1]]
    for i in range(len(xy) - 1, 0, -1):
        after.append(i if before[i] == i else after[-1])
    after.reverse()
    turn, there = _unwrapped(_direction(xy[before])), xy[before]
    gone = (xy - there).norm(dim=1) / (xy[after] - there).norm(dim=1).clamp_min(SHAKES)
    return torch.lerp(turn[before], turn[after], gone.clamp_max(1))


def _direction(xy: torch.Tensor) -> torch.Tensor:
    """Where the path goes at each point `[T, 2]`, radians; where it stands, the last direction it had (at first, the first it gets): what
    stops turns as it drives on, not on the spot."""
    ahead = torch.cat([xy.diff(dim=0), torch.zeros(1, 2, dtype=torch.float64)])
    behind = ahead.roll(1, 0)
    step = ahead + behind
    angles = torch.atan2(step[:, 1], step[:, 0])
    moving = step.norm(dim=-1) > 1e-3
    last = angles[moving][0] if moving.any() else torch.zeros((), dtype=torch.float64)
    moving[1:-1] &= behind[1:-1].norm(dim=-1) > 1e-3
    kept = []
    for angle, moves in zip(angles, moving, strict=True):
        last = angle if moves else last
        kept.append(last)
    return torch.stack(kept)
