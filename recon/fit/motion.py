"""Where cameras and actors are while each picture is taken: recorded poses and clocks, and the small corrections that a fit finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from recon.fit.model import Knots, scaled, small_poses
from recon.fit.shutter import shifts_of
from recon.frames import Frames
from recon.log import Track
from recon.view import View
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


Moment = tuple[torch.Tensor, dict[int, torch.Tensor]]
"""cam_from_world `[4, 4]`, and the actors' poses by group."""


class Motion:
    """Poses of cameras and actors at every view's moment and shortly before and after, differentiable in their corrections.

    ego.deltas `[K, 6]`, paths `[sum of K, 6]` of all actors one after the other, extrinsics `[C, 6]` a camera, clocks `[C]`: how much later
    than recorded it took its pictures.
    """

    def __init__(self, frames: Frames, rig: dict[str, RigCamera], ego: Knots, tracks: Sequence[Track]):
        self.rig, self.ego, self.tracks = [rig[name] for name in frames.names], ego, list(tracks)
        self.actors = actors = [Knots(t.trajectory()) for t in tracks]
        self.boxes = boxes = [t.size for t in tracks]
        self.extrinsics = torch.zeros(len(frames.names), 6)
        self.clocks = torch.zeros(len(frames.names))
        views = frames.views
        times = np.array([v.time_us for v in views])
        self.row = {(v.camera, v.index): i for i, v in enumerate(views)}
        self._body = ego.base(times)
        self._drift = drift(ego, times)
        # of all actors at every view `[V, A, ...]`
        counts = [len(knots.deltas) for knots in actors]
        self._first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.paths = torch.zeros(int(self._first[-1]), 6)
        between = [torch.arange(a + 1, a + n - 1) for a, n in zip(self._first.tolist(), counts, strict=False) if n > 2]
        self._inner = torch.cat([torch.zeros(0, dtype=torch.int64), *between])
        bases = [knots.base(times) for knots in actors]
        self._boxes, knot, share = (torch.stack(parts, 1) for parts in zip(*bases, strict=True)) if bases else _nobody(len(times))
        first, last = torch.from_numpy(self._first[:-1]), torch.from_numpy(self._first[1:] - 1)
        self._knots, self._shares = torch.stack([first + knot, torch.minimum(first + knot + 1, last)]), share.float()[..., None]
        self._drifts = torch.stack([drift(knots, times) for knots in actors], 1) if actors else torch.zeros(len(times), 0, 6)
        self._covers = torch.tensor([[k.trajectory.covers(t) for k in actors] for t in times], dtype=torch.bool).view(
            len(times), len(actors)
        )
        self._radii = torch.tensor([float(np.linalg.norm(box)) for box in boxes], dtype=torch.float64)

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

    def near(self, view: View, camera: Camera) -> torch.Tensor:
        """Which actors may be in a camera's view at the view's moment, int64."""
        row = self.row[view.camera, view.index]
        from_world = inverse(camera.world_from_cam.detach())
        x, _, z = (self._boxes[row, :, :3, 3] @ from_world[:3, :3].T + from_world[:3, 3]).unbind(-1)
        aside = x.abs() - 1.5 * self._radii < z.clamp_min(0) * (camera.width / (1.6 * camera.lens.focal()[0])) + self._radii
        return (self._covers[row] & (z > -self._radii) & aside).nonzero()[:, 0]

    def actor_poses(self, view: View, camera: Camera, later_us: float = 0.0) -> dict[int, torch.Tensor]:
        """Poses by group of the actors that may be in the camera's view at the view's moment, or `later_us` after it."""
        row, near = self.row[view.camera, view.index], self.near(view, camera)
        before, after = self._knots[:, row, near]
        share, late = self._shares[row, near], self.clocks[view.camera] + later_us / CLOCK_US
        deltas = self.paths[before] * (1 - share) + self.paths[after] * share
        poses = self._boxes[row, near] @ small_poses(scaled(deltas, *ACTOR) + self._drifts[row, near] * late)
        return {i + 1: pose for i, pose in zip(near.tolist(), poses.unbind(), strict=True)}

    @torch.no_grad()
    def readout(self, view: View, camera: Camera) -> list[Moment]:
        """cam_from_world, and the actors' poses, as the readout of a view begins and as it ends; nothing where it is instant."""
        half = self.rig[view.camera].readout_us / 2
        if not half or self.speeds()[self.row[view.camera, view.index]] < SLOW:
            return []
        return [(inverse(self.camera(view, late).world_from_cam), self.actor_poses(view, camera, late)) for late in (-half, half)]

    def as_read(self, placed: list[Placed], ends: list[Moment], view: View, camera: Camera) -> list[Placed]:
        """What stands before a view's camera, its splats moved to where they were when their rows were read; ends: of `readout`."""
        if not ends:
            return placed
        shutter = self.rig[view.camera].shutter
        first, last = (
            torch.stack([back @ (poses[p.instance] if p.instance else p.world_from_local) for p in placed]) for back, poses in ends
        )
        # all actors at once, which are many and small, and beside them what stands still, which is one and large
        shifts: dict[int, torch.Tensor] = {}
        for group in ([k for k, p in enumerate(placed) if not p.instance], [k for k, p in enumerate(placed) if p.instance]):
            if group:
                means = [placed[k].gaussians.means for k in group]
                shifts |= zip(group, shifts_of(means, first[group], last[group], camera, shutter), strict=True)
        return [replace(p, gaussians=replace(p.gaussians, means=p.gaussians.means + shifts[k])) for k, p in enumerate(placed)]

    def left(self, view: View) -> torch.Tensor:
        """The direction `[3]` to the body's left at a view."""
        return self._body[0][self.row[view.camera, view.index]][:3, 1]

    def parameters(self, refine: Sequence[str] = REFINED) -> list[torch.Tensor]:
        """What a fit corrects of what `refine` names; mounts and clocks only where there are several cameras, since the body's poses make
        up for those of one."""
        several = len(self.rig) > 1
        kinds = {
            "body": [self.ego.deltas], "mounts": [self.extrinsics] * several, "clocks": [self.clocks] * several,
            "actors": [self.paths] * bool(self.actors),
        }  # fmt: skip
        return [tensor for kind, tensors in kinds.items() if kind in refine for tensor in tensors]

    def unrest(self) -> torch.Tensor:
        """What corrections cost that shake, and clocks that are off."""
        bend = self.paths[self._inner + 1] - 2 * self.paths[self._inner] + self.paths[self._inner - 1]
        return CALM * (self.ego.unrest() + bend.square().sum() + self.clocks.square().sum())

    # ---- what it comes to

    def path(self) -> Trajectory:
        """The body's corrected trajectory."""
        return self.ego.corrected(*EGO)

    def trajectory(self, actor: int) -> Trajectory:
        """An actor's corrected trajectory."""
        self.actors[actor].deltas = self.paths[self._first[actor] : self._first[actor + 1]].detach()
        return self.actors[actor].corrected(*ACTOR)

    def mounted(self, camera: int, times_us: list[int]) -> tuple[torch.Tensor, torch.Tensor]:
        """A camera's corrected `body_from_cam`, and when it took its pictures of these times, int64 us."""
        mount = self.rig[camera].body_from_cam @ small_poses(scaled(self.extrinsics[camera].detach(), *EXTRINSIC))
        return mount, torch.tensor(times_us) + round(float(self.clocks[camera].detach()) * CLOCK_US)

    # ---- checkpoints

    def tensors(self) -> dict:
        return {
            "extrinsics": self.extrinsics.detach(), "clocks": self.clocks.detach(),
            "ego": self.ego.deltas.detach(), "actors": self.paths.detach(),
        }  # fmt: skip

    def restore(self, state: dict) -> None:
        self.extrinsics, self.clocks, self.ego.deltas, self.paths = (state[k] for k in ("extrinsics", "clocks", "ego", "actors"))


def _nobody(views: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """As `Knots.base`, of no actor."""
    return torch.zeros(views, 0, 4, 4, dtype=torch.float64), torch.zeros(views, 0, dtype=torch.int64), torch.zeros(views, 0)


def drift(knots: Knots, times_us: np.ndarray) -> torch.Tensor:
    """How a body moves in `CLOCK_US` at each time, float32 `[V, 6]`: rotation vector and metres in its own frame."""
    before, after = (knots.base(times_us + d)[0] for d in (-NEARBY_US, NEARBY_US))
    turn = inverse(before) @ after
    spin = torch.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1) / 2
    return (torch.cat([spin, turn[:, :3, 3]], 1) * (CLOCK_US / (2 * NEARBY_US))).float()
