"""Where cameras and actors are while each picture is taken: recorded poses and clocks, and the small corrections that a fit finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from recon.frames import Frames, View
from recon.model import Knots, scaled, small_poses
from recon.shutter import as_read
from scenes.camera import Camera, RigCamera
from scenes.gaussians import Placed
from scenes.poses import inverse
from scenes.trajectory import Trajectory

EGO, EXTRINSIC, ACTOR = (1e-3, 1e-2), (1e-3, 1e-3), (1e-2, 5e-2)
"""Radians and metres of one unit of a correction of the body's poses, a camera's mount, an actor's poses: the errors of recorded logs."""

REFINED = ("body", "mounts", "clocks", "actors")
"""What can be corrected: the body's path, how cameras are fixed to it, when they took their pictures, and the actors' paths."""

CLOCK_US = 1000.0
"""Microseconds of one unit of a camera's clock."""

CALM = 1e-4
"""Weight of the squared second differences of corrections: bodies do not shake."""

SLOW = 0.5
"""Metres a second up to which a readout is taken to be instant."""

NEARBY_US = 50_000
"""Half the time over which a speed is taken."""


class Motion:
    """Poses of cameras and actors at every view's moment and shortly before and after, differentiable in their corrections.

    ego.deltas `[K, 6]`, each actor's deltas, extrinsics `[C, 6]` a camera, clocks `[C]`: how much later than recorded it took its pictures.
    """

    def __init__(self, frames: Frames, rig: dict[str, RigCamera], ego: Knots, actors: list[Knots], boxes: list[np.ndarray]):
        self.rig, self.ego, self.actors, self.boxes = [rig[name] for name in frames.names], ego, actors, boxes
        self.extrinsics = torch.zeros(len(frames.names), 6)
        self.clocks = torch.zeros(len(frames.names))
        views = frames.views
        times = np.array([v.time_us for v in views])
        self.row = {(v.camera, v.index): i for i, v in enumerate(views)}
        self._body = ego.base(times)
        self._boxes = [knots.base(times) for knots in actors]
        self._covers = np.array([[k.trajectory.covers(t) for k in actors] for t in times]).reshape(len(times), len(actors))
        self._drift = drift(ego, times)
        self._drifts = [drift(knots, times) for knots in actors]

    def speeds(self) -> torch.Tensor:
        """Metres a second `[V]` of the body at every view."""
        return self._drift[:, 3:].norm(dim=1) * (1e6 / CLOCK_US)

    def camera(self, view: View, later_us: float = 0.0) -> Camera:
        """The view's camera at its corrected pose, or where it is `later_us` after its moment."""
        rig, row = self.rig[view.camera], self.row[view.camera, view.index]
        poses, knots, shares = self._body
        late = self.clocks[view.camera] + later_us / CLOCK_US
        delta = scaled(self.ego.correction(knots[row], shares[row]), *EGO) + self._drift[row] * late
        mount = rig.body_from_cam @ small_poses(scaled(self.extrinsics[view.camera], *EXTRINSIC))
        return Camera(rig.lens, rig.width, rig.height, poses[row] @ small_poses(delta) @ mount, time_us=view.time_us)

    def actor_poses(self, view: View, camera: Camera, later_us: float = 0.0) -> dict[int, torch.Tensor]:
        """Poses by group of the actors that may be in the camera's view at the view's moment, or `later_us` after it."""
        row = self.row[view.camera, view.index]
        from_world = inverse(camera.world_from_cam.detach())
        near, deltas = [], []
        for i in np.flatnonzero(self._covers[row]).tolist():
            poses, knots, shares = self._boxes[i]
            x, _, z = (from_world @ poses[row])[:3, 3].tolist()
            radius = float(np.linalg.norm(self.boxes[i]))
            if z > -radius and abs(x) - radius * 1.5 < max(z, 0) * camera.width / (1.6 * camera.lens.focal()[0]) + radius:
                near.append(i)
                deltas.append(self.actors[i].correction(knots[row], shares[row]))
        if not near:
            return {}
        late = self.clocks[view.camera] + later_us / CLOCK_US
        moved = small_poses(scaled(torch.stack(deltas), *ACTOR) + torch.stack([self._drifts[i][row] for i in near]) * late)
        return {i + 1: self._boxes[i][0][row] @ m for i, m in zip(near, moved, strict=True)}

    def as_read(self, placed: list[Placed], view: View, camera: Camera) -> list[Placed]:
        """What stands before a view's camera, its splats moved to where they were when their rows were read."""
        rig = self.rig[view.camera]
        if not rig.readout_us or self.speeds()[self.row[view.camera, view.index]] < SLOW:
            return placed
        ends = [(self.camera(view, late), self.actor_poses(view, camera, late)) for late in (-rig.readout_us / 2, rig.readout_us / 2)]
        from_world = [(inverse(c.world_from_cam.detach()), poses) for c, poses in ends]
        moved = []
        for p in placed:
            first, last = (back @ (poses[p.instance].detach() if p.instance else p.world_from_local) for back, poses in from_world)
            moved.append(replace(p, gaussians=as_read(p.gaussians, first, last, camera, rig.shutter)))
        return moved

    def left(self, view: View) -> torch.Tensor:
        """The direction `[3]` to the body's left at a view."""
        return self._body[0][self.row[view.camera, view.index]][:3, 1]

    def parameters(self, refine: Sequence[str] = REFINED) -> list[torch.Tensor]:
        """What a fit corrects of what `refine` names; mounts and clocks only where there are several cameras, since the body's poses make
        up for those of one."""
        several = len(self.rig) > 1
        kinds = {
            "body": [self.ego.deltas], "mounts": [self.extrinsics] * several, "clocks": [self.clocks] * several,
            "actors": [a.deltas for a in self.actors],
        }  # fmt: skip
        return [tensor for kind, tensors in kinds.items() if kind in refine for tensor in tensors]

    def unrest(self) -> torch.Tensor:
        """What corrections cost that shake, and clocks that are off."""
        return CALM * sum((k.unrest() for k in (self.ego, *self.actors)), self.clocks.square().sum())

    # ---- what it comes to

    def path(self) -> Trajectory:
        """The body's corrected trajectory."""
        return self.ego.corrected(*EGO)

    def trajectory(self, actor: int) -> Trajectory:
        """An actor's corrected trajectory."""
        return self.actors[actor].corrected(*ACTOR)

    def mounted(self, camera: int, times_us: list[int]) -> tuple[torch.Tensor, torch.Tensor]:
        """A camera's corrected `body_from_cam`, and when it took its pictures of these times, int64 us."""
        mount = self.rig[camera].body_from_cam @ small_poses(scaled(self.extrinsics[camera].detach(), *EXTRINSIC))
        return mount, torch.tensor(times_us) + round(float(self.clocks[camera].detach()) * CLOCK_US)

    # ---- checkpoints

    def tensors(self) -> dict:
        return {
            "extrinsics": self.extrinsics.detach(), "clocks": self.clocks.detach(),
            "ego": self.ego.deltas.detach(), "actors": [a.deltas.detach() for a in self.actors],
        }  # fmt: skip

    def restore(self, state: dict) -> None:
        self.extrinsics, self.clocks, self.ego.deltas = state["extrinsics"], state["clocks"], state["ego"]
        for knots, deltas in zip(self.actors, state["actors"], strict=True):
            knots.deltas = deltas


def drift(knots: Knots, times_us: np.ndarray) -> torch.Tensor:
    """How a body moves in `CLOCK_US` at each time, float32 `[V, 6]`: rotation vector and metres in its own frame."""
    before, after = (knots.base(times_us + d)[0] for d in (-NEARBY_US, NEARBY_US))
    turn = inverse(before) @ after
    spin = torch.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1) / 2
    return (torch.cat([spin, turn[:, :3, 3]], 1) * (CLOCK_US / (2 * NEARBY_US))).float()
