"""What the fit changes: the splats of background and actors, the sky, the exposures, and small corrections of poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from render import rasterize
from render.launch import upload
from scenes.camera import Camera
from scenes.gaussians import Gaussians, Placed, SplatModel
from scenes.harmonics import brighter
from scenes.poses import interpolate
from scenes.trajectory import Trajectory

FIELDS = ("means", "quats", "log_scales", "logits", "sh")


@dataclass
class Splats:
    """Splats of all groups (background first, then the actors) in one set of tensors, so that one step moves all.

    means `[N, 3]`, quats `[N, 4]`, log_scales `[N, 3]`, logits `[N]`, sh `[N, K, 3]`; sizes: splats a group;
    reach `[N]`: metres that 1000 pixels of the sharpest camera span where it comes nearest, by which steps and limits of a splat scale.
    """

    fields: dict[str, torch.Tensor]
    sizes: list[int]
    reach: torch.Tensor

    @staticmethod
    def of(groups: list[Gaussians], reach: list[torch.Tensor]) -> Splats:
        g = Gaussians.cat(groups)
        fields = (g.means, g.quats, g.log_scales, g.logit_opacities, g.sh)
        return Splats({k: v.clone() for k, v in zip(FIELDS, fields, strict=True)}, [len(p) for p in groups], torch.cat(reach))

    def __len__(self) -> int:
        return len(self.reach)

    def to(self, device: torch.device | str) -> Splats:
        """The same splats on a device."""
        return Splats({k: v.to(device) for k, v in self.fields.items()}, self.sizes, self.reach.to(device))

    def groups(self, sh_count: int) -> list[Gaussians]:
        """The splats of each group with the first `sh_count` coefficients; gradients flow back through one split a field."""
        *rest, sh = (self.fields[name] for name in FIELDS)
        sh = sh if sh.shape[1] == sh_count else sh[:, :sh_count]
        return [Gaussians(*part) for part in zip(*(torch.split(t, self.sizes) for t in (*rest, sh)), strict=True)]

    def placed(self, poses: dict[int, torch.Tensor]) -> list[Placed]:
        """The background, and the groups that have splats and a pose; the instance is the group's index."""
        there = [i for i, size in enumerate(self.sizes) if size or not i]
        parts = zip(*(self.fields[name].split([self.sizes[i] for i in there]) for name in FIELDS), strict=True)
        poses = {0: _STILL} | poses
        return [Placed(Gaussians(*part), poses[i], instance=i) for i, part in zip(there, parts, strict=True) if i in poses]

    def changed(self, **fields: torch.Tensor) -> Splats:
        """The same splats with other fields."""
        return Splats(self.fields | fields, self.sizes, self.reach)

    def select(self, which: torch.Tensor, sh_count: int) -> Splats:
        """Copies of the splats at rising indices `which`, with the first `sh_count` coefficients, for a step to differentiate."""
        fields = {k: (v[:, :sh_count] if k == "sh" else v).detach().index_select(0, which).requires_grad_() for k, v in self.fields.items()}
        ends = torch.searchsorted(which, upload(torch.tensor(self.sizes).cumsum(0), which.device))
        return Splats(fields, ends.diff(prepend=ends.new_zeros(1)).tolist(), self.reach.index_select(0, which))

    def held(self, which: torch.Tensor, names: Sequence[str]) -> Splats:
        """The same splats, of which some, bool `[N]`, are not differentiated by these fields."""
        of = {name: self.fields[name] for name in names}
        still = {name: torch.where(which.view(-1, *[1] * (field.ndim - 1)), field.detach(), field) for name, field in of.items()}
        return self.changed(**still)

    def group_of(self) -> torch.Tensor:
        """Group index `[N]` of every splat."""
        return torch.repeat_interleave(torch.arange(len(self.sizes)), torch.tensor(self.sizes)).to(self.reach.device)


_STILL = torch.eye(4, dtype=torch.float64)

_GENERATORS = torch.zeros(6, 4, 4, dtype=torch.float64)
"""What turning about each axis, and moving along it, adds to a small motion's matrix."""
for _axis, (_i, _j) in enumerate(((2, 1), (0, 2), (1, 0))):
    _GENERATORS[_axis, _i, _j], _GENERATORS[_axis, _j, _i], _GENERATORS[3 + _axis, _axis, 3] = 1, -1, 1

_POWERS = torch.arange(20, dtype=torch.float64)
_SERIES = torch.tensor([[(-1) ** k / math.factorial(2 * k + n) for n in (2, 3)] for k in range(20)], dtype=torch.float64)
"""Of (1 - cos a) / a^2 and (a - sin a) / a^3 in powers of a^2: to float64's last digits for up to a whole turn, and smooth at 0."""


def small_poses(deltas: torch.Tensor) -> torch.Tensor:
    """Poses `[..., 4, 4]` of small motions `[..., 6]`: rotation vector (radians, less than a turn), then translation (metres), by the
    exponential map, which of such a matrix is a cubic (Rodrigues' formula)."""
    deltas = deltas.to(torch.float64)
    once = (deltas @ _GENERATORS.flatten(1)).unflatten(-1, (4, 4))
    twice = once @ once
    square = deltas[..., :3].square().sum(-1, keepdim=True)
    second, third = (square**_POWERS @ _SERIES)[..., None, None].unbind(-3)
    return _STILL + once + second * twice + third * (twice @ once)


def scaled(raw: torch.Tensor, radians: float, metres: float) -> torch.Tensor:
    """A correction `[..., 6]` in its units as radians and metres."""
    return raw * raw.new_tensor([radians] * 3 + [metres] * 3)


def _between(times_us: np.ndarray, at_us: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """For each moment the index of the earlier neighbour and the share of the later one; beyond 0..1 outside."""
    if len(times_us) == 1:
        return torch.zeros(len(at_us), dtype=torch.long), torch.zeros(len(at_us), dtype=torch.float64)
    k = np.searchsorted(times_us, at_us).clip(1, len(times_us) - 1) - 1
    return torch.from_numpy(k), torch.from_numpy((at_us - times_us[k]) / (times_us[k + 1] - times_us[k]))


class Knots:
    """A trajectory with small corrections `[K, 6]` in the body's own frame at some of its times, the knots; between them linear.

    Poses that nothing trains, those of held-out frames, are no knots: their neighbours' corrections carry them.
    """

    def __init__(self, trajectory: Trajectory, knots_us: torch.Tensor | None = None):
        self.trajectory = trajectory
        self.knots_us = trajectory.times_us if knots_us is None else knots_us
        self.deltas = torch.zeros(len(self.knots_us), 6)

    def base(self, times_us: np.ndarray) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Uncorrected poses `[V, 4, 4]` at times, and for each the earlier knot and the share of the later one."""
        k, u = _between(self.trajectory.times_us.numpy(), times_us)
        poses = self.trajectory.world_from_body
        knot, share = _between(self.knots_us.numpy(), times_us)
        # corrections are held, not extrapolated, beyond the first and last knot
        return interpolate(poses[k], poses[(k + 1).clamp_max(len(poses) - 1)], u), knot, share.clamp(0, 1)

    def correction(self, knot: torch.Tensor, share: torch.Tensor) -> torch.Tensor:
        """Small motions `[..., 6]` between knots; differentiable in `deltas`."""
        after = (knot + 1).clamp_max(len(self.deltas) - 1)
        share = share.to(self.deltas)[..., None]
        return self.deltas[knot] * (1 - share) + self.deltas[after] * share

    def corrected(self, radians: float, metres: float) -> Trajectory:
        """The trajectory with its corrections, in these units, applied."""
        _, knot, share = self.base(self.trajectory.times_us.numpy())
        deltas = scaled(self.correction(knot, share).detach(), radians, metres)
        return replace(self.trajectory, world_from_body=self.trajectory.world_from_body @ small_poses(deltas))

    def unrest(self) -> torch.Tensor:
        """Sum of squared second differences of the corrections: bodies do not shake."""
        d = self.deltas
        return (d[2:] - 2 * d[1:-1] + d[:-2]).square().sum() if len(d) > 2 else d.sum() * 0


def dimmed_actors(splats: Splats, gain: torch.Tensor | None) -> Splats:
    """The splats of all groups, those of actors so much less bright as cameras were exposed more, by a gain `[3]`; as they are where that
    is None."""
    if gain is None:
        return splats
    sh, still = splats.fields["sh"], splats.sizes[0]
    return splats.changed(sh=torch.cat([sh[:still], brighter(sh[still:], 1 / gain.to(sh))]))


MODEL = SplatModel(projection="ewa")
"""What is trained: EWA costs less than UT, and splats this small look the same under both."""


def draw(
    placed: list[Placed], camera: Camera, *outputs: str, features: list[torch.Tensor] | None = None, scale: float = 1.0
) -> list[torch.Tensor]:
    """The named outputs of one picture under `MODEL`; features `[N, C]` of each of the placed. scale: how large the picture is to those
    that the finished splats are fitted to."""
    frame = rasterize(placed, camera, outputs, model=MODEL.at_scale(scale), features=features)
    return [getattr(frame, name) for name in outputs]
