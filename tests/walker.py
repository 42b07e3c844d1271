"""The made-up street with people who walk, as a log in memory: legs swing from the hips, knees bend, arms swing against them.

Angles follow a walking adult's (Winter 1991): hips swing by 25 degrees to either side, knees bend by 10 to 60 degrees, and a stride is
0.8 of the height.
"""

import io
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from street import START_US, STEP_US, box, rig, road, sky, splats

from recon.log import LidarPoints, Log, LogCamera, Packed, Sweep, Track
from render import render_frame
from scenes import Actor, Asset, Gaussians, Ground, Placed, RigCamera, Scene, Trajectory
from scenes.poses import pose_from, translation

STRIDE = 0.8
SIZE = (0.9, 0.6, 1.75)
SKIN, SHIRT, JEANS, SHOES = (0.8, 0.6, 0.5), (0.75, 0.2, 0.15), (0.15, 0.2, 0.45), (0.9, 0.9, 0.85)


def limb(size, colour, step=0.05) -> Gaussians:
    """A box that hangs from the origin."""
    part = box(size, colour, step)
    return replace(part, means=part.means - torch.tensor([0.0, 0.0, size[2]]))


def swung(part: Gaussians, angle: float, at) -> Gaussians:
    """A part turned about y through the origin, forward where the angle is positive, and then moved."""
    turn = pose_from([math.cos(angle / 2), 0.0, -math.sin(angle / 2), 0.0], [0.0, 0.0, 0.0])[:3, :3].float()
    return replace(part, means=part.means @ turn.T + torch.tensor(at))


def person(phase: float) -> Gaussians:
    """Splats of a person 1.75 m tall whose stride is at a phase in radians; x forward, the soles at z = 0. As many at every phase."""
    parts = [
        replace(t, means=t.means + torch.tensor([0.0, 0.0, z]))
        for t, z in ((box((0.24, 0.36, 0.55), SHIRT, 0.06), 0.9), (box((0.2, 0.16, 0.25), SKIN, 0.05), 1.5))
    ]
    for side, own in ((0.1, phase), (-0.1, phase + math.pi)):
        hip, knee = math.radians(25) * math.sin(own), math.radians(35 + 25 * math.cos(own))
        joint = torch.tensor([[0.42 * math.sin(hip), side, 0.9 - 0.42 * math.cos(hip)]])
        shank = Gaussians.cat([limb((0.12, 0.12, 0.4), JEANS), limb((0.22, 0.1, 0.08), SHOES)])
        foot = shank.means.clone()
        foot[-len(limb((0.22, 0.1, 0.08), SHOES)) :] += torch.tensor([0.05, 0.0, -0.38])
        parts += [
            swung(limb((0.15, 0.15, 0.45), JEANS), hip, (0.0, side, 0.92)),
            swung(replace(shank, means=foot), hip - knee, joint[0].tolist()),
            swung(limb((0.1, 0.09, 0.6), SHIRT), -0.8 * hip, (0.0, 2.3 * side, 1.43)),
        ]
    return Gaussians.cat(parts)


@dataclass(frozen=True)
class Walking(Scene):
    """A scene whose actors are people who walk as far as their trajectories go; those named in `stiff` do not move their limbs."""

    stiff: tuple[str, ...] = ()

    def phase(self, actor: Actor, time_us: int) -> float:
        path = actor.trajectory
        metres = float((path.near(time_us) - path.world_from_body[0])[:3, 3].norm())
        return 0.6 if actor.track in self.stiff else 2 * math.pi * metres / (STRIDE * float(actor.asset.size[2]))

    def placed(self, time_us: int, readout_us: int = 0) -> list[Placed]:
        still, *people = super().placed(time_us, readout_us)
        return [still, *(replace(p, gaussians=person(self.phase(self.actors[p.instance - 1], time_us))) for p in people)]


def crossing() -> Gaussians:
    """White stripes along the street, half a metre wide and as far apart, where one person crosses it."""
    x, y = torch.meshgrid(torch.arange(5.0, 12.0, 0.05), torch.arange(-4.0, 4.0, 0.05), indexing="ij")
    painted = (torch.floor(y / 0.5) % 2 == 0).flatten()
    points = torch.stack([x, y, torch.full_like(x, 0.02)], -1).reshape(-1, 3)[painted]
    return splats(points, (0.98, 0.98, 0.98), (0.05, 0.04, 0.01))


def walk(frames=32, width=192, height=108, stiff: tuple[str, ...] = (), striped=False) -> Walking:
    """A slow car's front and left camera; one person crosses the street before it, on stripes or not, another walks ahead of it along the
    kerb."""
    times = START_US + STEP_US * torch.arange(frames + 1)
    ego = torch.stack([translation(0.05 * i, 0.0, 0.0) for i in range(frames + 1)])
    left = pose_from([math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)], [0.0, 0.0, 0.0])
    across = torch.stack([translation(7.5, -2.2 + 0.135 * i, 0.0) @ left for i in range(frames + 1)])
    ahead = torch.stack([translation(5.0 + 0.12 * i, 2.0, 0.0) for i in range(frames + 1)])
    cameras = {n: replace(c, times_us=times[:-1] + (20_000 if n == "left_camera" else 0)) for n, c in rig(width, height).items()}
    whoever = Asset(person(0.0), SIZE, "pedestrian")
    return Walking(
        Placed(Gaussians.cat([road(), crossing()]) if striped else road(), torch.eye(4, dtype=torch.float64)),
        (Actor(whoever, Trajectory(times, across), "ped_1"), Actor(whoever, Trajectory(times, ahead), "ped_2")),
        sky(),
        Trajectory(times, ego),
        cameras,
        ground=Ground(torch.zeros(40, 60), (-10.0, -20.0), 1.0),
        meta={"name": "walk", "licence": "CC0-1.0"},
        stiff=stiff,
    )


def log_of(scene: Walking, label="pedestrian") -> Log:
    """What a car records of it: pictures of a global shutter, a lidar's points without noise of the skin, the people's boxes."""
    lidar = torch.arange(0, len(scene.ego) - 1)
    times = scene.ego.times_us[lidar].numpy()

    def sweep(time: int) -> LidarPoints:
        chance = np.random.default_rng(time)
        points = []
        for p in scene.placed(time):
            means = p.gaussians.means.double()
            some = torch.from_numpy(chance.random(len(means)) < (0.4 if p.instance == 0 else 0.25))
            points.append((means[some] @ p.world_from_local[:3, :3].T + p.world_from_local[:3, 3]).numpy())
        xyz = np.concatenate(points)
        xyz[: len(points[0]), :2] += chance.uniform(-0.25, 0.25, (len(points[0]), 2))
        return LidarPoints(xyz, np.full(len(xyz), time), np.zeros(len(xyz), np.int64))

    tracks = tuple(
        Track(a.track, label, True, np.array(SIZE), a.trajectory.times_us.numpy(), a.trajectory.world_from_body,
              np.full(len(a.trajectory), -1), (a.track,))
        for a in scene.actors
    )  # fmt: skip
    cameras = {name: _recorded(scene, name, camera) for name, camera in scene.rig.items()}
    sweeps = tuple(Sweep(i, int(t), lambda t=int(t): sweep(t)) for i, t in enumerate(times))
    return Log("walk", Path("walk"), cameras, sweeps, tracks, scene.ego, dict(scene.meta), tuple(cameras))


def _recorded(scene: Walking, name: str, camera: RigCamera) -> LogCamera:
    files, poses = [], []
    for time in camera.times_us.tolist():
        view = scene.camera(name, time)
        with torch.no_grad():
            rgb = render_frame(scene, view).rgb
        file = io.BytesIO()
        Image.fromarray((rgb.clamp(0, 1) * 255).round().byte().numpy()).save(file, "PNG")
        files.append(Packed(f"{name} {time}", file.getvalue))
        poses.append(view.world_from_cam)
    return LogCamera(name, camera.lens, camera.width, camera.height, tuple(files), camera.times_us, torch.stack(poses))
