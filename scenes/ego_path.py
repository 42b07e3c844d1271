"""Paths that the recording car never drove: beside the recorded one, over into another lane, or a way of their own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from scenes.collide import HALF
from scenes.lateral import Keyframe
from scenes.metres import require_metres
from scenes.poses import interpolate, inverse, translation, yaw, yaw_of
from scenes.scene import Scene
from scenes.standing import EDGE, outside_ground, standing_pose
from scenes.trajectory import Trajectory, between
from scenes.waypoints import SIDEWAYS, STEP_US, Way, sliding_warning, way_of

CAR = (3.0, 2 * HALF, 1.6)
"""Length, width and height in metres about a body's origin that are the recording car, wherever on it that lies."""

FINE_US = 20_000
"""Between the poses of a lane change: less than between frames, so that what lies between them is straight."""

STEEPEST = 15 / 8
"""Of a lane change's mean slope, that of its middle."""


def changing_lane(ego: Trajectory, keyframes: Sequence[Keyframe], start_us: int, end_us: int) -> tuple[Trajectory, list[str]]:
    """A recorded path with a shift to the left that changes on the way, by keyframes counted from a clip's first frame at `start_us`,
    and what to tell of it until the last one at `end_us`.

    Between two keyframes the car goes over along a quintic of the distance that it drives, which begins and ends along the road without a
    jolt (Takahashi et al. 1989), and heads where it goes; where it hardly drives, it slides sideways over that time, which is told. Speed,
    height and tilt stay as recorded. Before the first keyframe and after the last the shift is theirs.
    """
    at = torch.tensor([start_us + k.time_us for k in keyframes])
    left = torch.tensor([k.left for k in keyframes], dtype=torch.float64)
    first, last = ego.span_us() if len(ego) > 1 else (start_us, start_us + FINE_US)
    ends = torch.tensor([first, last])
    times = torch.cat([ego.times_us, at.clamp(first, last), torch.arange(first, last, FINE_US), ends]).unique()
    recorded = ego.near_each(times)
    ahead = (recorded[1:, :2, 3] - recorded[:-1, :2, 3]) * torch.nn.functional.normalize(recorded[:-1, :2, 0], dim=1)
    metres = torch.cat([torch.zeros(1, dtype=torch.float64), ahead.sum(1).cumsum(0)])  # forwards: who stands shakes on the spot

    def gone(time_us: int) -> float:
        """Metres driven until then; beyond the drive as fast as in its first and last second."""
        inside = min(max(time_us, first), last)
        other = min(first + 1_000_000, last) if time_us < inside else max(last - 1_000_000, first)
        here, there = (float(between(times, metres, t)) for t in (inside, other))
        return here + (here - there) / (inside - other) * (time_us - inside) if time_us != inside else here

    aside, turn, notes = left[0].expand(len(times)).clone(), torch.zeros_like(metres), []
    for k, rise in enumerate(left.diff().tolist()):
        begin, end = int(at[k]), int(at[k + 1])
        during, length = times > begin, gone(end) - gone(begin)
        slides = abs(rise) * STEEPEST >= length * math.tan(math.radians(SIDEWAYS))
        share = (times - begin) / (end - begin) if slides else (metres - gone(begin)) / length
        u = torch.where(times < end, share.double(), 1.0)[during].clamp(0, 1)
        aside[during] = left[k] + rise * u**3 * (10 - 15 * u + 6 * u**2)
        if slides and rise and begin < end_us and end > start_us:
            hardly = f"drives {length:.1f} m from {keyframes[k].time_us / 1e6:g}s to {keyframes[k + 1].time_us / 1e6:g}s"
            notes.append(f"the recording car {hardly}, too little to go over by {abs(rise):g}m, and slides sideways; give it more time")
        elif rise and not slides:
            turn[during] = torch.atan(rise * 30 * (u * (1 - u)) ** 2 / length)
    shift = translation().repeat(len(times), 1, 1)
    shift[:, 1, 3] = aside
    return Trajectory(times, recorded @ shift @ torch.stack([yaw(float(angle)) for angle in turn])), notes


def driven(scene: Scene, file: Path, start_us: int, end_us: int) -> tuple[Trajectory, list[str]]:
    """The path of a CSV trajectory (`scenes.placement.read_waypoints`), relative to the recorded body at a clip's first frame, and what to
    tell of it.

    Each pose is as high above the ground, and as tilted to it, as the recorded body was where that came nearest; where the ground is not
    known, it lies in that body's own plane. ValueError where the file is bad, or does not last from the clip's first frame to its last at
    `end_us`; where the scene is not metric.
    """
    require_metres(scene, f"the trajectory {file}")
    way = way_of(file, scene.ego.at(start_us), start_us)
    if (late := int(way.times_us[0])) > start_us:
        told = f"{file} begins {(late - start_us) / 1e6:g}s after the clip's first frame"
        raise ValueError(f"{told}; let time_s begin at 0, or earlier")
    if (early := int(way.times_us[-1])) < end_us:
        lasts = f"{file} ends {(early - start_us) / 1e6:g}s after the clip's first frame, and the clip's last frame is at"
        raise ValueError(f"{lasts} {(end_us - start_us) / 1e6:g}s; add rows, or give --duration {max(early - start_us, 1) / 1e6:g}s")
    way = _during(way, start_us - STEP_US, end_us + STEP_US)  # each pose takes looks at the ground; a shutter reads beyond the clip
    poses = [_lifted(scene, xy, float(heading)) for xy, heading in zip(way.xy, way.headings, strict=True)]
    slides = sliding_warning("the recording car", _during(way, start_us, end_us), file, start_us)
    return Trajectory(way.times_us, torch.stack(poses)), slides


def nearest(ego: Trajectory, xy: torch.Tensor) -> torch.Tensor:
    """`world_from_body` `[4, 4]` of a recorded path where it comes nearest to a world point `[2]`."""
    if len(ego) == 1:
        return ego.world_from_body[0]
    here = ego.world_from_body[:, :2, 3]
    step = here.diff(dim=0)
    u = (((xy - here[:-1]) * step).sum(1) / (step * step).sum(1).clamp_min(1e-12)).clamp(0, 1)
    k = int((here[:-1] + u[:, None] * step - xy).norm(dim=1).argmin())
    return interpolate(ego.world_from_body[k], ego.world_from_body[k + 1], float(u[k]))


def _lifted(scene: Scene, xy: torch.Tensor, heading: float) -> torch.Tensor:
    """The pose `[4, 4]` of the recording car at a world point `[2]`, facing a heading."""
    recorded = nearest(scene.ego, xy)
    turn = heading - float(yaw_of(recorded))
    normal, away = recorded[:3, 2], xy - recorded[:2, 3]
    flat = recorded @ yaw(turn)
    flat[:2, 3], flat[2, 3] = xy, recorded[2, 3] - (normal[:2] @ away) / normal[2]
    if scene.ground is None:
        return flat
    size = torch.tensor(CAR, dtype=torch.float64)
    below = standing_pose(scene, recorded[:2, 3], float(yaw_of(recorded)), size)
    there = standing_pose(scene, xy, heading, size) @ (inverse(below) @ recorded)
    there[:2, 3] = xy
    beyond = max(outside_ground(scene, xy), outside_ground(scene, recorded[:2, 3]))
    return interpolate(flat, there, max(0.0, 1 - beyond / EDGE))


def _during(way: Way, start_us: int, end_us: int) -> Way:
    there = (way.times_us >= start_us) & (way.times_us <= end_us)
    return replace(way, times_us=way.times_us[there], xy=way.xy[there], headings=way.headings[there])
