"""How people walk: the deformations of actors that have limbs, found together with their splats."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch

from recon.fit.model import Splats
from recon.fit.strides import gone, phase, waves
from recon.log import Track
from scenes.camera import Camera
from scenes.deformation import Deformation, Lattice, between

MODES = 4
"""A walk's mean posture and four more hold 98 % of it: the stride's two phases and twice its frequency's (Troje 2002)."""

CELL = 0.2
"""Metres between nodes: legs hang less than that apart."""

MARGIN = 0.25
"""Metres around a box that the lattice reaches: as far as its splats may stand (`densify.BOX_MARGIN`)."""

STEP_US = 100_000
"""Between the times whose weights are found."""

UNIT = 0.1
"""Metres of one unit of a mode."""

RATE, LEAST = 0.06, 0.03
"""Adam's first step of modes and weights in their units (weights a third of it), and what part of it is left at the end."""

EVEN, STEADY = 1e-5, 1e-4
"""Weights of squared differences between neighbouring nodes of a mode, and of second ones of weights over time, for an actor that fills the
picture, and as much less as it fills of it: what no picture shows goes with what stands around it."""


class Limb:
    """One actor's lattice: modes `[B, X, Y, Z, 3]` in `UNIT`s, and what is added `[T, B]` to the weights of an even gait: cosine and sine
    of the phase of its strides, and of twice that."""

    def __init__(self, track: Track, span_us: tuple[int, int], stride: float, device: torch.device | str = "cpu"):
        """span_us: of the pictures; stride: its length in metres; device: of modes and weights. Corners and times stay on the host."""
        half = torch.from_numpy(track.size[:2]).float() / 2 + MARGIN
        high = float(track.size[2]) + MARGIN
        self.corners = torch.tensor([[-half[0], -half[1], -MARGIN], [half[0], half[1], high]])
        counts = ((self.corners[1] - self.corners[0]) / CELL).round().long().clamp(1, 16) + 1
        self.path, self.metres2 = track.trajectory(), float(track.size[:2].max() * track.size[2])
        self.modes = torch.zeros(MODES, *counts.tolist(), 3, device=device).requires_grad_()
        first, last = max(int(track.times_us[0]), span_us[0]), min(int(track.times_us[-1]), span_us[1])
        self.times_us = torch.from_numpy(np.linspace(first, last, max(1, (last - first) // STEP_US) + 1).round().astype(np.int64))
        self.gait = waves(phase(gone(track.trajectory(), self.times_us), self.times_us, stride), MODES).float().to(device)
        self.added = torch.zeros_like(self.gait).requires_grad_()

    def at(self, time_us: int) -> Lattice:
        """The lattice at a time; differentiable."""
        weights = between(self.times_us, self.gait + self.added, time_us)
        return Lattice(self.corners, UNIT * torch.tensordot(weights, self.modes, 1))

    def unrest(self, camera: Camera) -> torch.Tensor:
        """What neighbours cost that part, and weights that shake, in the loss of a camera's picture."""
        apart = torch.stack([self.modes.diff(dim=axis).square().sum() for axis in (1, 2, 3)]).sum()
        away = (self.path.near(camera.time_us)[:3, 3] - camera.world_from_cam.detach()[:3, 3]).norm()
        across, down = (float(f / away) for f in camera.lens.focal())
        share = min(1.0, self.metres2 * across * down / (camera.width * camera.height))
        return share * (EVEN * apart + STEADY * self.added.diff(n=2, dim=0).square().sum())

    def deformation(self) -> Deformation | None:
        """What was found, on the host; None where no picture showed the actor."""
        if not self.modes.any():
            return None
        weights = (self.gait + self.added).detach()
        return Deformation(self.corners, UNIT * self.modes.detach().cpu(), self.times_us, weights.cpu())


class Limbs:
    """The limbs of all actors that are seen to move some, by group; none where nobody is, which costs nothing."""

    def __init__(self, strides: Mapping[int, float], tracks: Sequence[Track], span_us: tuple[int, int], device: torch.device | str = "cpu"):
        """strides: metres, by group; tracks: those of the groups from 1 on; span_us: of the pictures; device: of the splats."""
        self.of = {group: Limb(tracks[group - 1], span_us, stride, device) for group, stride in strides.items()}
        groups = [{"params": [limb.modes for limb in self.of.values()]}, {"params": [limb.added for limb in self.of.values()]}]
        self._adam = torch.optim.Adam(groups, lr=RATE, eps=1e-12) if self.of else None

    def bent(self, splats: Splats, time_us: int) -> Splats:
        """The splats of all groups as those with limbs are bent at a time; differentiable."""
        means, moves = list(splats.fields["means"].split(splats.sizes)), [i for i in self.of if splats.sizes[i]]
        for i in moves:
            means[i] = means[i] + self.of[i].at(time_us).at(means[i])
        return splats.changed(means=torch.cat(means)) if moves else splats

    def unrest(self, groups: Iterable[int], camera: Camera) -> torch.Tensor | float:
        """`Limb.unrest` of those of the groups that have limbs: what a picture does not show is left as it is."""
        return sum(self.of[i].unrest(camera) for i in groups if i in self.of)

    def follow(self, progress: float) -> None:
        """One step along the gradients, at a part of the fit."""
        if self._adam is None:
            return
        for group, share in zip(self._adam.param_groups, (1.0, 1 / 3), strict=True):
            group["lr"] = RATE * share * LEAST**progress
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    # ---- checkpoints

    def tensors(self) -> dict:
        found = {i: [limb.modes.detach(), limb.added.detach()] for i, limb in self.of.items()}
        return {"found": found, "adam": self._adam.state_dict() if self._adam else {}}

    @torch.no_grad()
    def restore(self, state: dict) -> None:
        for i, (modes, added) in state["found"].items():
            self.of[i].modes.copy_(modes)
            self.of[i].added.copy_(added)
        if self._adam:
            self._adam.load_state_dict(state["adam"])
