"""A place with what moves in it, seen along any rays at any time, in the light of a sun and of what is open around."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from render.rays import camera_rays, readout, world_directions
from render.tracer import Blockers, Mesh, TracedMesh, fibonacci
from scenes import Fisheye, Pinhole
from scenes.camera import Camera, RigCamera
from scenes.poses import CAM_FROM_FLU, inverse, translation
from scenes.poses import yaw as turn
from scenes.sky import linear_from_srgb, srgb_from_linear
from scenes.trajectory import Trajectory

START_US = 1_700_000_000_000_000

SAMPLES = 2
"""Rays a pixel along each side of it."""

AROUND = 24
"""Directions in which a point is asked whether it is open."""

OFF = 4e-3
"""Metres off a surface at which its light is looked for."""

CIRCLE = math.radians(95.0)
"""From the axis, as far as a lens shows anything: beyond, a picture is black."""

TICK_US = 1000
"""While a picture is read out row by row, movers stand still for so long."""

UNSEEN = -2
"""Who is there in a pixel that no light reaches."""

Level = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
"""Metres that the road is high, or would be, at places x and y."""


@dataclass(frozen=True)
class Light:
    """sun: unit direction to it; sunlight and ambient: linear colours that a white surface that faces it, or is wholly open, sends back;
    reach: metres within which what stands around takes of the ambient light, bounced: of which this part comes all the same."""

    sun: tuple[float, float, float]
    sunlight: tuple[float, float, float]
    ambient: tuple[float, float, float]
    reach: float
    bounced: float = 0.0


@dataclass(frozen=True)
class Part:
    """A rigid piece of a mover, in the frame of the box that `trajectory` moves, base centre, x forward, which swings about y through
    `joint` by up to `amplitude` radians, so many times a second."""

    mesh: Mesh
    joint: tuple[float, float, float] = (0.0, 0.0, 0.0)
    amplitude: float = 0.0
    hertz: float = 0.0
    phase: float = 0.0

    def in_box(self, seconds: float) -> torch.Tensor:
        """box_from_part `[4, 4]`, float64."""
        angle = self.amplitude * np.sin(2 * np.pi * self.hertz * seconds + self.phase)
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 0] = pose[2, 2] = np.cos(angle)
        pose[0, 2], pose[2, 0] = np.sin(angle), -np.sin(angle)
        joint = torch.tensor(self.joint, dtype=torch.float64)
        pose[:3, 3] = joint - pose[:3, :3] @ joint
        return pose


@dataclass(frozen=True)
class Mover:
    """Someone on a way through the place: `size` is length, width and height of the box."""

    track: str
    label: str
    size: tuple[float, float, float]
    parts: tuple[Part, ...]
    trajectory: Trajectory

    @cached_property
    def traced(self) -> list[TracedMesh]:
        return [TracedMesh(part.mesh) for part in self.parts]

    def poses(self, time_us: int) -> list[torch.Tensor]:
        """world_from_part `[4, 4]` of each."""
        base, seconds = self.trajectory.near(time_us), time_us * 1e-6
        return [base @ part.in_box(seconds) for part in self.parts]


@dataclass(frozen=True)
class Place:
    """A world with a recorder in it. lidar: elevations of its beams in degrees, and where it stands on the body; aside: shifts, metres to
    the left and upwards, at which the truth is looked at; level: the road's; stops: moments in microseconds, and how many stops longer than
    at first its cameras expose then, `[2, T]`."""

    name: str
    still: Mesh
    movers: tuple[Mover, ...]
    light: Light
    ego: Trajectory
    rig: dict[str, RigCamera]
    lidar: tuple[tuple[float, ...], tuple[float, float, float]]
    aside: tuple[tuple[float, float], ...]
    level: Level = lambda x, y: torch.zeros_like(x)
    stops: np.ndarray | None = None

    @cached_property
    def traced(self) -> TracedMesh:
        return TracedMesh(self.still)

    def seen(self, camera: Camera) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """What a camera takes at once or row by row: rgb `[H, W, 3]` display-referred; depth `[H, W]` in metres, inf in the sky, and who is
        there, `[H, W]`, `UNSEEN` past a fisheye's edge, -1 sky, 0 what stands still, movers from 1, both along the rays through the pixels'
        centres. Shade is that of one moment, halfway."""
        fine = camera.resized(camera.width * SAMPLES, camera.height * SAMPLES)
        small = self._shaded(fine).reshape(camera.height, SAMPLES, camera.width, SAMPLES, 3).mean((1, 3))
        (_, distance, _, who), rays = self._first(*_rays(camera)), camera_rays(camera)
        depth, who = (found.reshape(camera.height, camera.width) for found in (distance, who))
        beyond = torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2]) > CIRCLE
        small[beyond], who[beyond] = 0.0, UNSEEN
        if self.stops is not None:
            small = small * 2 ** float(np.interp(camera.time_us, *self.stops))
        return srgb_from_linear(small.clamp(0, 1)), depth / rays.norm(dim=-1), who

    def distances(self, origins: torch.Tensor, directions: torch.Tensor, time_us: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Metres along unit world rays `[N, 3]` to the first surface, inf for none, and who it is, as `seen` says."""
        _, distance, _, who = self._first(origins, directions, torch.full((len(origins),), time_us))
        return distance, who

    def _first(self, origins: torch.Tensor, directions: torch.Tensor, times_us: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Albedo `[N, 3]` sRGB, metres `[N]`, world normals `[N, 3]`, and who `[N]`, along rays of a time each."""
        colours, normals, distance = self.traced.trace(origins, directions)
        who = torch.where(distance.isfinite(), 0, -1)
        ticks, tick = times_us.unique(return_inverse=True)
        for number, mover in enumerate(self.movers, 1):
            for traced, poses in zip(mover.traced, zip(*map(mover.poses, ticks.tolist()), strict=True), strict=True):
                forth = torch.stack(poses)
                back = inverse(forth).float()
                local, ways = _moved(back, tick, origins) + back[tick, :3, 3], _moved(back, tick, directions)
                near = _meets(traced.mesh, local, ways).nonzero()[:, 0]
                if not len(near):
                    continue
                c, n, t = traced.trace(local[near], ways[near])
                first = t < distance[near]
                at = near[first]
                colours[at], distance[at], who[at] = c[first], t[first], number
                normals[at] = _moved(forth.float(), tick[at], n[first])
        return colours[:, :3], distance, normals, who

    def _shaded(self, camera: Camera) -> torch.Tensor:
        """Linear colours `[N, 3]` of all pixels."""
        origins, directions, times_us = _rays(camera)
        albedo, distance, normals, who = self._first(origins, directions, times_us)
        solid = who >= 0
        points = origins[solid] + directions[solid] * distance[solid, None] + OFF * normals[solid]
        halfway = camera.time_us + camera.readout_us // 2
        blockers, sun = Blockers(self._triangles(halfway)), torch.tensor(self.light.sun)[None]
        lit = blockers.open_share(points, sun, torch.ones(1), 1e3) * (normals[solid] @ sun[0]).clamp_min(0)
        open_ = blockers.open_share(points, fibonacci(AROUND), torch.ones(AROUND), self.light.reach).clamp_min(self.light.bounced)
        light = lit[:, None] * torch.tensor(self.light.sunlight) + 2 * open_[:, None] * torch.tensor(self.light.ambient)
        colours = sky(directions)
        colours[solid] = linear_from_srgb(albedo[solid]) * light
        return colours

    def _triangles(self, time_us: int) -> np.ndarray:
        found = [self.still.vertices[self.still.faces]]
        for mover in self.movers:
            for part, pose in zip(mover.parts, mover.poses(time_us), strict=True):
                m = pose.numpy().astype(np.float32)
                found.append((part.mesh.vertices @ m[:3, :3].T + m[:3, 3])[part.mesh.faces])
        return np.concatenate(found)


def _rays(camera: Camera) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Where a camera's rays begin and unit world directions through its pixels' centres, `[H W, 3]` both, and when, `[H W]`, to a tick."""
    directions = torch.nn.functional.normalize(world_directions(camera).reshape(-1, 3), dim=1)
    eyes = readout(camera, camera.world_from_cam, camera.world_from_cam_end)[:, :3, 3].float()
    late = TICK_US * ((torch.arange(camera.height) + 0.5) / camera.height * camera.readout_us / TICK_US).floor().long()
    return eyes.repeat_interleave(camera.width, 0), directions, (camera.time_us + late).repeat_interleave(camera.width)


def _moved(poses: torch.Tensor, which: torch.Tensor, ways: torch.Tensor) -> torch.Tensor:
    """Directions `[N, 3]` turned each by the one of `poses` `[T, 4, 4]` that `which` `[N]` says."""
    if len(poses) == 1:
        return ways @ poses[0, :3, :3].T
    return torch.einsum("nij,nj->ni", poses[which, :3, :3], ways)


def _meets(mesh: Mesh, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Which rays meet the sphere around a mesh."""
    low, high = torch.from_numpy(mesh.vertices.min(0)), torch.from_numpy(mesh.vertices.max(0))
    to, radius = (low + high) / 2 - origins, float((high - low).norm()) / 2
    along = (to * directions).sum(1)
    return (along > -radius) & ((to * to).sum(1) - along**2 < radius**2)


def sky(directions: torch.Tensor) -> torch.Tensor:
    """Linear colours `[N, 3]` of a blue sky with clouds that is white at the horizon."""
    up = directions[:, 2:].clamp_min(0)
    blue = torch.tensor([0.75, 0.85, 0.95]) * (1 - up) ** 3 + torch.tensor([0.16, 0.34, 0.75]) * (1 - (1 - up) ** 3)
    x, y = (directions[:, i] / (directions[:, 2].clamp_min(0) + 0.15) for i in (0, 1))
    clouds = sum((torch.sin(f * x + 1.3 * f) * torch.sin(f * y + 0.7 * f * x) for f in (1.1, 2.3, 4.9)), torch.zeros(len(x)))
    return torch.lerp(blue, torch.ones(3), (0.35 * clouds[:, None]).clamp(0, 0.7))


def looking(size: tuple[int, int], angle: float, yaw: float, at: Sequence[float], times_us: torch.Tensor) -> RigCamera:
    """A pinhole camera `angle` degrees wide, `at` metres ahead, left and up on the body, turned to the left by `yaw` degrees."""
    focal = size[0] / 2 / math.tan(math.radians(angle) / 2)
    mount = translation(*at) @ turn(math.radians(yaw)) @ inverse(CAM_FROM_FLU)
    return RigCamera(Pinhole(focal, focal, size[0] / 2, size[1] / 2), *size, mount, times_us=times_us)


def fisheye(size: tuple[int, int], angle: float, at: Sequence[float], times_us: torch.Tensor) -> RigCamera:
    """An equidistant fisheye that looks ahead, `angle` degrees wide from the left edge to the right one; else as `looking`."""
    focal = size[0] / math.radians(angle)
    return RigCamera(Fisheye(focal, focal, size[0] / 2, size[1] / 2), *size, translation(*at) @ inverse(CAM_FROM_FLU), times_us=times_us)


def clock(frames: int, step_us: int) -> torch.Tensor:
    """When so many pictures are taken, microseconds."""
    return START_US + step_us * torch.arange(frames)


def along(points: Sequence[Sequence[float]], speed: float, times_us: torch.Tensor) -> Trajectory:
    """A trajectory over the ground from the first of points `[x, y]` through the others, and straight on, at a constant speed in m/s."""
    return gone(points, speed * (times_us - times_us[0]).numpy() * 1e-6, times_us)


def gone(points: Sequence[Sequence[float]], metres: np.ndarray, times_us: torch.Tensor) -> Trajectory:
    """The like, gone so far `[T]` at times `[T]`."""
    way = np.asarray(points, np.float64)
    marks = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])

    def where(m: np.ndarray) -> np.ndarray:
        inside = np.stack([np.interp(m, marks, way[:, i]) for i in (0, 1)], 1)
        last = (way[-1] - way[-2]) / np.linalg.norm(way[-1] - way[-2])
        return inside + (m - marks[-1]).clip(0)[:, None] * last

    heading = where(metres + 0.4) - where(np.maximum(metres - 0.4, 0))
    poses = [translation(x, y) @ turn(math.atan2(dy, dx)) for (x, y), (dx, dy) in zip(where(metres), heading, strict=True)]
    return Trajectory(times_us, torch.stack(poses))
