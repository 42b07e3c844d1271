"""How far aside of the recorded path a camera can go before it is where nothing was recorded: behind a wall, or off the known ground."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from render.frame_types import Frame
from render.rasterize import rasterize
from scenes.camera import Camera
from scenes.insert import outside_ground
from scenes.lenses import Pinhole
from scenes.scene import Scene
from scenes.spread import spread
from scenes.trajectory import Trajectory

LOOKS = 40
"""Places along a clip from which is looked aside."""

PIXELS, WIDE = 16, math.radians(10)
"""Of the picture that is taken there, along each side: what stands in the way of a camera, not a wire or a twig."""

BEFORE = 0.5
"""Metres before what stands there that a camera can still go: nearer, it is between the splats of it."""

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
    frame = rasterize(scene.background, looking, ("median_depth",), model=scene.model)
    assert isinstance(frame, Frame) and frame.median_depth is not None
    room = min(reach, max(0.0, float(frame.median_depth.median()) - BEFORE))
    while room > 0 and (beyond := outside_ground(scene, (eye + room * aside)[:2])) > 0:
        room = max(0.0, room - max(STEP, beyond))
    return room


def shift_warning(scene: Scene, recorded: Sequence[Camera], ego: Trajectory, shift: float) -> list[str]:
    """What to tell of a clip that is shifted to where nothing was recorded: a sentence, or nothing. recorded: its cameras, unshifted."""
    if not shift:
        return []
    looks = spread(recorded, LOOKS)
    room = [room_aside(scene, camera, ego.at(camera.time_us), shift > 0, abs(shift)) for camera in looks]
    least = min(room)
    if least >= abs(shift):
        return []
    after, side = (looks[room.index(least)].time_us - recorded[0].time_us) / 1e6, "left" if shift > 0 else "right"
    whole = STEP * math.floor(least / STEP)
    fix = f"the largest shift that makes sense there is {math.copysign(whole, shift):g}m" if whole else "no shift to that side makes sense"
    return [
        f"--lateral-shift {shift:g}m goes beyond what was recorded: {after:.1f}s after the clip's first frame something stands, or the "
        f"known ground ends, {least + BEFORE:.1f} m to the {side} of the path, and what is behind is a guess; {fix}"
    ]
