"""How far aside of the recorded path a camera can go before it is behind a wall, off the known ground or farther than is measured, and a
car before it runs into something."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from render.frame_types import Frame
from render.rasterize import rasterize
from render.rays import camera_rays
from scenes.asset import Actor
from scenes.camera import Camera
from scenes.collide import hollow, into, met
from scenes.ego_path import CAR, nearest
from scenes.lenses import Pinhole
from scenes.poses import inverse, yaw_of
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

TURNED = math.radians(60)
"""From the nearest camera's axis from which on a camera sees little of what that showed."""

SIGHTS, ACROSS, FRAMES = 5, 32, 50
"""Moments of a clip at which it is looked what a camera shows, pixels across its picture then, and frames of each camera that may have
shown that."""

FARTHEST = 200.0
"""Metres at which the sky is taken to be then."""

UNSEEN = 0.05
"""Part of a picture from which on it is told that no camera saw it."""

STEP, FINE = 0.5, 0.1
"""Metres, of which the largest shift is told in whole ones: it is measured no better; the finer where no car drove, as indoors."""

PARTS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18)
"""Of a car's size, the largest at which what recorded the drive went where it went is its own: robots are narrower than cars."""

MEASURED = 3.0
"""Metres aside up to which it is measured how well views hold (`recon/evaluation/offpath.py`)."""

SMEARED = f"how well views hold is measured up to {MEASURED:g}m, and farther off they smear"


@torch.no_grad()
def room_aside(scene: Scene, camera: Camera, world_from_body: torch.Tensor, left: bool, reach: float) -> float:
    """Metres, up to `reach`, that a camera of a body at a pose can go to the left or right before it meets what stands or leaves the known
    ground."""
    aside = world_from_body[:3, 1] * (1.0 if left else -1.0)
    eye = camera.world_from_cam[:3, 3]
    room = min(reach, max(0.0, _free(scene, eye, aside, -world_from_body[:3, 2]) - BEFORE))
    while room > 0 and (beyond := outside_ground(scene, (eye + room * aside)[:2])) > 0:
        room = max(0.0, room - max(STEP, beyond))
    return room


def _free(scene: Scene, eye: torch.Tensor, way: torch.Tensor, down: torch.Tensor) -> float:
    """Metres from an eye `[3]` to what stands in a way; `down`: a direction at right angles to it."""
    pose, focal = torch.eye(4, dtype=torch.float64), PIXELS / 2 / math.tan(WIDE / 2)
    pose[:3, :3] = torch.stack([torch.linalg.cross(down, way), down, way], 1)
    pose[:3, 3] = eye
    return float(_depth(scene, Camera(Pinhole(focal, focal, PIXELS / 2, PIXELS / 2), PIXELS, PIXELS, pose)).median())


def _depth(scene: Scene, camera: Camera) -> torch.Tensor:
    """`[H, W]`, of what stands still."""
    frame = rasterize(scene.background, camera, ("median_depth",), model=scene.model_for(camera))
    assert isinstance(frame, Frame) and frame.median_depth is not None
    return frame.median_depth


@torch.no_grad()
def sight_warning(scene: Scene, name: str, cameras: Sequence[Camera]) -> list[str]:
    """What to tell of a clip by a camera of one's own (`Scene.own`): that something stands between it and the nearest camera of the rig, or
    else that it is far from where any of these drove, how much of what it shows no camera of the rig ever had in its picture, hidden there
    or not, and how much of the picture its lens does not reach; a sentence each, or nothing."""
    looks = spread(cameras, SIGHTS)
    said = _behind(scene, name, looks) or _off_the_rig(scene, name, looks)
    if (unseen := max(_unseen(scene, look) for look in looks)) >= UNSEEN:
        told = f"{name} shows what no camera recorded on {unseen:.0%} of its pixels"
        said.append(f"{told}, which is a guess; turn it to where a camera looked, or narrow its view")
    if (dark := float((camera_rays(looks[0]) == 0).all(-1).double().mean())) >= UNSEEN:
        told = "its distortion folds over there: check the numbers and their order, and whether it is a fisheye"
        said.append(f"{name} sees nothing on {dark:.0%} of its pixels, since {told}")
    return said


def _behind(scene: Scene, name: str, looks: Sequence[Camera]) -> list[str]:
    mount = scene.own[name].body_from_cam
    near = min((c.body_from_cam for c in scene.rig.values()), key=lambda m: float((mount - m)[:3, 3].norm()))
    moved = (mount - near)[:3, 3]
    reach = float(moved.norm())
    across = torch.linalg.cross(moved, torch.eye(3, dtype=torch.float64)[int(moved.abs().argmin())])
    for look in looks if reach > BEFORE else []:
        body = look.world_from_cam @ inverse(mount)
        free = _free(scene, (body @ near)[:3, 3], body[:3, :3] @ moved / reach, body[:3, :3] @ across / across.norm())
        if free < reach:
            where = f"{name} is {reach:.1f} m from the nearest recorded camera, and something stands {free:.1f} m from that towards it"
            return [f"{where}, {_after(looks, look.time_us)}: what is behind is a guess; move it nearer"]
    return []


def _off_the_rig(scene: Scene, name: str, looks: Sequence[Camera]) -> list[str]:
    """Told of a mount that is far beside the ways of the rig's cameras, or above them; not of one that a shift alone leads there."""
    ways = torch.stack([c.body_from_cam[1:3, 3] for c in scene.rig.values()])
    if float((scene.own[name].body_from_cam[1:3, 3] - ways).norm(dim=1).min()) <= BEFORE:
        return []
    eyes = torch.stack([look.world_from_cam[:, 3] for look in looks])
    local = torch.stack([inverse(nearest(scene.ego, eye[:2])) @ eye for eye in eyes])[:, 1:3]
    off = float((local[:, None] - ways).norm(dim=2).min(1).values.max())
    if round(off, 1) <= MEASURED + STEP:
        return []
    return [f"{name} is {off:.1f} m beside or above where any recorded camera drove: {SMEARED}; mount it within {MEASURED:g}m of there"]


def _unseen(scene: Scene, camera: Camera) -> float:
    """Part of a picture that shows what was in no recorded one."""
    small = camera.resized(ACROSS, max(1, round(ACROSS * camera.height / camera.width)))
    rays = camera_rays(small).double()
    shown = (rays != 0).any(-1)  # past the edge of a fisheye's image there is nothing to show
    points = rays[shown] * _depth(scene, small)[shown].double().clamp_max(FARTHEST)[:, None]
    points = points @ camera.world_from_cam[:3, :3].T + camera.world_from_cam[:3, 3]
    seen = torch.zeros(len(points), dtype=torch.bool)
    for name, c in scene.rig.items():
        times = torch.stack(spread(list(scene.frame_times(name)), FRAMES))
        back = inverse(scene.ego.near_each(times) @ c.body_from_cam)
        local = points @ back[:, :3, :3].mT + back[:, None, :3, 3]
        pixels = c.lens.project(local)
        inside = (pixels >= 0).all(-1) & (pixels <= torch.tensor([c.width, c.height])).all(-1)
        seen |= (c.lens.valid(local) & inside).any(0)
    return 1 - float(seen.double().mean())


def path_warning(scene: Scene, recorded: Sequence[Camera], path: float | Trajectory, said: str) -> list[str]:
    """What to tell of a clip from where nothing was recorded, or where no car can drive: a sentence each, or nothing. recorded: its
    cameras, unshifted; path: metres to the left of the recorded path, or any other path of the body; said: what asked for it."""
    if isinstance(path, float | int) and not path:
        return []
    looks = spread(recorded, LOOKS)
    if not isinstance(path, Trajectory):
        return _beyond(scene, looks, path, said) or _in_the_way(scene, looks, path, said) + _far(scene, looks, path, said)
    where = _beyond(scene, looks, path, said) or _off(scene, looks, path, said)
    where = where or _in_the_way(scene, looks, path, said) + _far(scene, looks, path, said)
    return where + _turned(scene, looks, path, said)


def _beyond(scene: Scene, looks: Sequence[Camera], path: float | Trajectory, said: str) -> list[str]:
    asides = [_aside(scene, path, camera.time_us) for camera in looks]
    lacks = []
    for camera, (body, left) in zip(looks, asides, strict=True):
        there = replace(camera, world_from_cam=body @ inverse(scene.ego.at(camera.time_us)) @ camera.world_from_cam)
        lacks.append(abs(left) - room_aside(scene, there, body, left > 0, abs(left)))
    most = max(lacks)
    if most <= 0:
        return []
    worst = lacks.index(most)
    left = asides[worst][1]
    room, side, after = abs(left) - most, "left" if left > 0 else "right", _after(looks, looks[worst].time_us)
    if isinstance(path, Trajectory):
        ends = f"it is {abs(left):.1f} m to the {side} of the recorded path, and something stands {room + BEFORE:.1f} m to that side of it"
        fix = "stay nearer to the recorded path there"
        return [f"{said} goes beyond what was recorded: {after} {ends}, or the known ground ends, and what is behind is a guess; {fix}"]
    step = _step(_size(scene, looks))
    whole = step * math.floor(round(room / step, 6))
    fix = f"the largest shift short of that is {math.copysign(whole, path):g}m" if whole else "no shift to that side makes sense"
    return [
        f"{said} goes beyond what was recorded: {after} something stands, or the known ground ends, "
        f"{room + BEFORE:.1f} m to the {side} of the path, and what is behind is a guess; {fix}"
    ]


def _off(scene: Scene, looks: Sequence[Camera], path: Trajectory, said: str) -> list[str]:
    """Told of a path that goes on before the recorded one begins or after it ends, so that nothing is aside of it."""
    off = next((look.time_us for look in looks if outside_ground(scene, path.at(look.time_us)[:2, 3]) > 0), None)
    if off is None:
        return []
    return [f"{said} leaves the known ground {_after(looks, off)}, and what is there is a guess; stay nearer to the recorded path"]


def _far(scene: Scene, looks: Sequence[Camera], path: float | Trajectory, said: str) -> list[str]:
    """Told of an open street, too: cameras saw it from the recorded path only. Half a metre is let pass, for a lane change."""
    asides = [abs(_aside(scene, path, look.time_us)[1]) for look in looks]
    most = max(asides)
    if round(most, 1) <= MEASURED + STEP:
        return []
    after = _after(looks, looks[asides.index(most)].time_us)
    where = f"is {most:.1f} m beside the recorded path, {after}" if isinstance(path, Trajectory) else "leads far beside the recorded path"
    return [f"{said} {where}: {SMEARED}; stay within {MEASURED:g}m of it"]


def _turned(scene: Scene, looks: Sequence[Camera], path: Trajectory, said: str) -> list[str]:
    """Told by the camera's axis, and those that the rig's cameras had where the path is nearest."""
    for look in looks:
        body = path.at(look.time_us)
        axis = (body @ inverse(scene.ego.at(look.time_us)) @ look.world_from_cam)[:3, 2]
        recorded = nearest(scene.ego, body[:2, 3])
        off = min(math.acos(float((axis @ (recorded @ c.body_from_cam)[:3, 2]).clamp(-1, 1))) for c in scene.rig.values())
        if off > TURNED:
            turned = f"{said} looks {math.degrees(off):.0f}deg away from where any camera looked there, {_after(looks, look.time_us)}"
            return [f"{turned}, and what it shows may be a guess; face more along the recorded path"]
    return []


def _in_the_way(scene: Scene, looks: Sequence[Camera], path: float | Trajectory, said: str) -> list[str]:
    """Told by the car's box, since its camera may look over the roofs of what stands there."""
    if scene.ground is None:
        return []
    size = _size(scene, looks)
    hit = _struck(scene, looks, path, size)
    if hit is None:
        return []
    runs = f"{said} takes the recording car through {hit[0]}, {_after(looks, hit[1])}"
    if isinstance(path, Trajectory):
        return [f"{runs}; lead it past there"]
    step = _step(size)
    less = math.ceil(round(abs(path) / step, 6)) - 1
    while less > 0 and _struck(scene, looks, math.copysign(less * step, path), size):
        less -= 1
    fix = f"at {math.copysign(less * step, path):g}m its way is free" if less else "no shift to that side is free"
    return [f"{runs}; {fix}"]


def _step(size: torch.Tensor) -> float:
    """What a shift of what has a size `[3]` is told in whole ones of."""
    return STEP if float(size[0]) >= CAR[0] else FINE


def _size(scene: Scene, looks: Sequence[Camera]) -> torch.Tensor:
    """Length, width and height `[3]` of what recorded the drive: a car's, or as much less as makes its own way free."""
    sizes = [part * torch.tensor(CAR, dtype=torch.float64) for part in PARTS]
    if scene.ground is None:
        return sizes[0]
    times = _times(looks)
    return next((size for size in sizes if not into(scene, _car(scene, scene.ego, times, size), times)), sizes[-1])


def _times(looks: Sequence[Camera]) -> list[int]:
    return sorted({camera.time_us for camera in looks})


def _car(scene: Scene, ego: Trajectory, times: list[int], size: torch.Tensor) -> Actor:
    """What recorded the drive, of a size `[3]`, on the ground along a path."""
    poses = [standing_pose(scene, body[:2, 3], float(yaw_of(body)), size) for body in map(ego.at, times)]
    return hollow(scene, size, "Car", Trajectory(torch.tensor(times), torch.stack(poses)))


def _struck(scene: Scene, looks: Sequence[Camera], path: float | Trajectory, size: torch.Tensor) -> tuple[str, int] | None:
    """What the recording car, of a size `[3]`, runs into first on a path, and when; None where its way is free."""
    times = _times(looks)
    car = _car(scene, path if isinstance(path, Trajectory) else scene.ego.shifted(lateral=path), times, size)
    found = [(f"{other.track} ({other.asset.label})", t) for other, t in met(scene, car, times)]
    if standing := into(scene, car, times):
        found.append(("what stands there, as a parked car or a pole", standing[0]))
    return min(found, key=lambda hit: hit[1], default=None)


def _aside(scene: Scene, path: float | Trajectory, time_us: int) -> tuple[torch.Tensor, float]:
    """The recorded body's pose `[4, 4]` that a path is beside at a time, and how many metres to the left of it."""
    if not isinstance(path, Trajectory):
        return scene.ego.at(time_us), path
    body = path.at(time_us)
    recorded = nearest(scene.ego, body[:2, 3])
    return recorded, float((inverse(recorded) @ body)[1, 3])


def _after(looks: Sequence[Camera], time_us: int) -> str:
    return f"{(time_us - looks[0].time_us) / 1e6:.1f}s after the clip's first frame"
