"""How far aside of the recorded path a camera can go before it is behind a wall or off the known ground, and a car before it runs into
something."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from render.frame_types import Frame
from render.rasterize import rasterize
from scenes.asset import Actor, Asset
from scenes.camera import Camera
from scenes.collide import HALF, into, met
from scenes.lenses import Pinhole
from scenes.poses import yaw_of
from scenes.scene import Scene
from scenes.spread import spread
from scenes.standing import outside_ground, standing_pose
from scenes.trajectory import Trajectory

LOOKS = 40
"""Places along a clip from which is looked aside."""

PIXELS, WIDE = 16, math.radians(10)
"""Of the picture that is taken there, along each side: what stands in the way of a camera, not a wire or a twig."""

BEFORE = 0.5
"""Metres before what stands there that a camera can still go: nearer, it is between the splats of it."""

CAR = (3.0, 2 * HALF, 1.6)
"""Length, width and height in metres about a body's origin that are the recording car, wherever on it that lies."""

STEP = 0.5
"""Metres, of which the largest shift is told in whole ones: it is measured no better."""


@torch.no_grad()
def room_aside(scene: Scene, camera: Camera, world_from_body: torch.Tensor, left: bool, reach: float) -> float:
    """Metres, up to `reach`, that a camera of a body at a pose can go to the left or right before it meets what stands or leaves the known
    ground."""
    aside = world_from_body[:3, 1] * (1.0 if left else -1.0)
    down = -world_from_body[:3, 2]
    eye, pose = camera.world_from_cam[:3, 3], torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([torch.linalg.cross(down, aside), down, aside], 1)
    pose[:3, 3] = eye
    focal = PIXELS / 2 / math.tan(WIDE / 2)
    looking = Camera(Pinhole(focal, focal, PIXELS / 2, PIXELS / 2), PIXELS, PIXELS, pose)
    frame = rasterize(scene.background, looking, ("median_depth",), model=scene.model_for(looking))
    assert isinstance(frame, Frame) and frame.median_depth is not None
    room = min(reach, max(0.0, float(frame.median_depth.median()) - BEFORE))
    while room > 0 and (beyond := outside_ground(scene, (eye + room * aside)[:2])) > 0:
        room = max(0.0, room - max(STEP, beyond))
    return room


def shift_warning(scene: Scene, recorded: Sequence[Camera], shift: float) -> list[str]:
    """What to tell of a clip that is shifted to where nothing was recorded, or where no car can drive: a sentence each, or nothing.
    recorded: its cameras, unshifted."""
    if not shift:
        return []
    looks = spread(recorded, LOOKS)
    return _beyond(scene, looks, shift) or _in_the_way(scene, looks, shift)


def _beyond(scene: Scene, looks: Sequence[Camera], shift: float) -> list[str]:
    room = [room_aside(scene, camera, scene.ego.at(camera.time_us), shift > 0, abs(shift)) for camera in looks]
    least = min(room)
    if least >= abs(shift):
        return []
    after, side = _after(looks, looks[room.index(least)].time_us), "left" if shift > 0 else "right"
    whole = STEP * math.floor(least / STEP)
    fix = f"the largest shift that makes sense there is {math.copysign(whole, shift):g}m" if whole else "no shift to that side makes sense"
    return [
        f"--lateral-shift {shift:g}m goes beyond what was recorded: {after} something stands, or the known ground ends, "
        f"{least + BEFORE:.1f} m to the {side} of the path, and what is behind is a guess; {fix}"
    ]


def _in_the_way(scene: Scene, looks: Sequence[Camera], shift: float) -> list[str]:
    """Told by the car's box, since its camera may look over the roofs of what stands there."""
    hit = _struck(scene, looks, shift) if scene.ground is not None else None
    if hit is None:
        return []
    less = math.ceil(abs(shift) / STEP) - 1
    while less > 0 and _struck(scene, looks, math.copysign(less * STEP, shift)):
        less -= 1
    fix = f"at {math.copysign(less * STEP, shift):g}m its way is free" if less else "no shift to that side is free"
    return [f"--lateral-shift {shift:g}m takes the recording car through {hit[0]}, {_after(looks, hit[1])}; {fix}"]


def _struck(scene: Scene, looks: Sequence[Camera], shift: float) -> tuple[str, int] | None:
    """What the recording car runs into first beside its path, and when; None where its way is free."""
    size, times = torch.tensor(CAR, dtype=torch.float64), sorted({camera.time_us for camera in looks})
    poses = []
    for body in (scene.ego.at(t) for t in times):
        poses.append(standing_pose(scene, body[:2, 3] + shift * body[:2, 1], float(yaw_of(body)), size))
    nothing = scene.background.gaussians.select(torch.zeros(0, dtype=torch.int64))
    car = Actor(Asset(nothing, size, "Car"), Trajectory(torch.tensor(times), torch.stack(poses)), "")
    found = [(f"{other.track} ({other.asset.label})", t) for other, t in met(scene, car, times)]
    if standing := into(scene, car, times):
        found.append(("what stands there, as a parked car or a pole", standing[0]))
    return min(found, key=lambda hit: hit[1], default=None)


def _after(looks: Sequence[Camera], time_us: int) -> str:
    return f"{(time_us - looks[0].time_us) / 1e6:.1f}s after the clip's first frame"
