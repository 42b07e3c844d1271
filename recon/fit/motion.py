"""Where cameras and actors are while each picture is taken: recorded poses and clocks, and the small corrections that a fit finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from recon.fit.knots import Knots, scaled
from recon.fit.model import Splats
from recon.fit.shutter import readout_shifts
from recon.log import Track
from recon.views.frames import Frames
from recon.views.view import View
from scenes.camera import Camera, RigCamera
from scenes.lenses import OpenCV, Pinhole
from scenes.poses import inverse, small_poses
from scenes.trajectory import Trajectory

EGO, EXTRINSIC, TURNED = (1e-3, 1e-2), (1e-3, 1e-3), 1e-2
"""Radians and metres of one unit of a correction of the body's poses and a camera's mount, and radians of one of an actor's poses, whose
metres its track tells: the errors of recorded logs."""

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


@dataclass(frozen=True)
class Shot:
    """What a camera sees of a view's moment.

    actors: poses `[4, 4]` by group of all there are; near: the groups that may be in the camera's view; read: cam_from_local float64
    `[2, 1 + A, 4, 4]` of the world and of all actors, as the readout of the view begins and as it ends; None where it is instant.
    """

    view: View
    camera: Camera
    actors: dict[int, torch.Tensor]
    near: list[int]
    read: torch.Tensor | None = None

    def poses(self) -> dict[int, torch.Tensor]:
        """Of those that may be in view."""
        return {i: self.actors[i] for i in self.near}

    def backs(self) -> tuple[torch.Tensor, torch.Tensor]:
        """cam_from_world `[4, 4]` as the readout begins and as it ends."""
        if self.read is not None:
            return self.read[0, 0], self.read[1, 0]
        back = inverse(self.camera.world_from_cam.detach())
        return back, back

    def at_once(self) -> Shot:
        """The same without a readout."""
        return replace(self, read=None)


class _Around(NamedTuple):
    """The body at a view's moment and, behind it, the actors that there are: their groups (the body's is 0), uncorrected poses
    `[1 + A, 4, 4]`, shares `[1 + A, 1]` of the later of their `knots` `[2, 1 + A]` among all corrections, drifts `[1 + A, 6]`, units
    `[1 + A, 6]` of corrections, and radii."""

    groups: list[int]
    bases: torch.Tensor
    shares: torch.Tensor
    drifts: torch.Tensor
    knots: torch.Tensor
    units: torch.Tensor
    radii: np.ndarray


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
        # of the body and, one after the other behind it, all actors at every view
        all_knots = [ego, *actors]
        counts = [len(knots.deltas) for knots in all_knots]
        self._first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.paths = torch.zeros(int(self._first[-1] - self._first[1]), 6)
        between = [torch.arange(a, a + n - 2) for a, n in zip(self._first[1:-1] - self._first[1], counts[1:], strict=True) if n > 2]
        self._inner = torch.cat([torch.zeros(0, dtype=torch.int64), *between])
        bases, knot, share = (torch.stack(parts, 1) for parts in zip(*(knots.base(times) for knots in all_knots), strict=True))
        first, last = torch.from_numpy(self._first[:-1]), torch.from_numpy(self._first[1:] - 1)
        knots, shares = torch.stack([first + knot, torch.minimum(first + knot + 1, last)], 1), share.float()[..., None]
        drifts = torch.stack([drift(knots, times) for knots in all_knots], 1)
        self.units = [(TURNED, t.off) for t in tracks]
        units = torch.tensor([[turn] * 3 + [metres] * 3 for turn, metres in (EGO, *self.units)])
        radii = np.array([0.0, *(np.linalg.norm(box) for box in boxes)])
        self._speeds = drifts[:, 0, 3:].norm(dim=1) * (1e6 / CLOCK_US)
        self._around = []
        for row, time in enumerate(times):
            there = [0, *(i for i, k in enumerate(actors, 1) if k.trajectory.covers(time))]
            base, part, way = (of[row, there] for of in (bases, shares, drifts))
            self._around.append(_Around(there, base, part, way, knots[row][:, there], units[there], radii[there]))

    def speeds(self) -> torch.Tensor:
        """Metres a second `[V]` of the body at every view."""
        return self._speeds

    def camera(self, view: View) -> Camera:
        """The view's camera at its corrected pose."""
        return self._rig_at(view, self._poses(view, [0.0])[0][0, 0])

    def shot(self, view: View, size: tuple[int, int] | None = None) -> Shot:
        """The view's camera at its corrected pose, of pictures of this width and height, and what it sees."""
        moves = self._speeds[self.row[view.camera, view.index]] >= SLOW
        half = self.rig[view.camera].readout_us / 2 if moves else 0.0
        poses, groups = self._poses(view, [0.0, -half, half] if half else [0.0])
        camera = self._rig_at(view, poses[0, 0])
        camera = camera if size is None else camera.resized(*size)
        read = None
        if half:
            there, still = poses[1:].detach(), torch.eye(4, dtype=torch.float64).expand(2, 1, 4, 4)
            read = inverse(there[:, :1]) @ torch.cat([still, there[:, 1:]], 1)
        return Shot(view, camera, dict(zip(groups, poses[0, 1:].unbind(), strict=True)), self.near(view, camera), read)

    def beside(self, shot: Shot, camera: Camera) -> Shot:
        """What another camera sees of the same moment at one go."""
        return replace(shot, camera=camera, near=self.near(shot.view, camera), read=None)

    def as_read(self, splats: Splats, shot: Shot) -> Splats:
        """What stands before a view's camera, its splats moved to where they were when their rows were read."""
        if shot.read is None:
            return splats
        row = {0: 0} | {group: k for k, group in enumerate(shot.actors, 1)}
        there = [i for i, size in enumerate(splats.sizes) if size]
        first, last = shot.read[:, [row.get(i, 0) for i in there]]  # who is not there is not placed either
        means, shutter = splats.fields["means"], self.rig[shot.view.camera].shutter
        shifts = readout_shifts(means, [splats.sizes[i] for i in there], first, last, shot.camera, shutter)
        return splats.changed(means=means + shifts)

    def near(self, view: View, camera: Camera) -> list[int]:
        """Groups of the actors that may be in a camera's view at the view's moment: all of them where its lens may look aside, or back."""
        around = self._around[self.row[view.camera, view.index]]
        if not isinstance(camera.lens, Pinhole | OpenCV):
            return around.groups[1:]
        pose, places, radii = camera.world_from_cam.detach().numpy(), around.bases.numpy()[1:, :3, 3], around.radii[1:]
        x, _, z = ((places - pose[:3, 3]) @ pose[:3, :3]).T
        aside = np.abs(x) - 1.5 * radii < np.maximum(z, 0) * (camera.width / (1.6 * camera.lens.focal()[0])) + radii
        return [group for group, seen in zip(around.groups[1:], (z > -radii) & aside, strict=True) if seen]

    def _rig_at(self, view: View, world_from_cam: torch.Tensor) -> Camera:
        rig = self.rig[view.camera]
        return Camera(rig.lens, rig.width, rig.height, world_from_cam, time_us=view.time_us)

    def _poses(self, view: View, later_us: list[float]) -> tuple[torch.Tensor, list[int]]:
        """Corrected poses `[T, 1 + A, 4, 4]` of the view's camera and of the actors that there are, so much later than the view's moment;
        and these actors' groups."""
        around = self._around[self.row[view.camera, view.index]]
        late = self.clocks[view.camera] + torch.tensor(later_us) / CLOCK_US
        corrections = torch.cat([self.ego.deltas, self.paths]).index_select(0, around.knots.flatten())
        before, after = corrections.view(*around.knots.shape, 6)
        deltas = (before * (1 - around.shares) + after * around.shares) * around.units
        deltas = deltas + around.drifts * late[:, None, None]
        mount = scaled(self.extrinsics[view.camera], *EXTRINSIC)
        small = small_poses(torch.cat([deltas.flatten(0, 1), mount[None]]))
        poses = around.bases @ small[:-1].view(*deltas.shape[:2], 4, 4)
        cameras = poses[:, :1] @ (self.rig[view.camera].body_from_cam @ small[-1])
        return torch.cat([cameras, poses[:, 1:]], 1), around.groups[1:]

    def left(self, view: View) -> torch.Tensor:
        """The direction `[3]` to the body's left at a view."""
        return self._around[self.row[view.camera, view.index]].bases[0, :3, 1]

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
        bend = (self.paths[2:] - 2 * self.paths[1:-1] + self.paths[:-2]).index_select(0, self._inner)
        return CALM * (self.ego.unrest() + bend.square().sum() + self.clocks.square().sum())

    # ---- what it comes to

    def path(self) -> Trajectory:
        """The body's corrected trajectory."""
        return self.ego.corrected(*EGO)

    def trajectory(self, actor: int) -> Trajectory:
        """An actor's corrected trajectory."""
        first, last = self._first[actor + 1 : actor + 3] - self._first[1]
        self.actors[actor].deltas = self.paths[first:last].detach()
        return self.actors[actor].corrected(*self.units[actor])

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


def drift(knots: Knots, times_us: np.ndarray) -> torch.Tensor:
    """How a body moves in `CLOCK_US` at each time, float32 `[V, 6]`: rotation vector and metres in its own frame."""
    before, after = (knots.base(times_us + d)[0] for d in (-NEARBY_US, NEARBY_US))
    turn = inverse(before) @ after
    spin = torch.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1) / 2
    return (torch.cat([spin, turn[:, :3, 3]], 1) * (CLOCK_US / (2 * NEARBY_US))).float()
