"""What the fit changes: the splats of background and actors, the sky, the exposures, and small corrections of poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from render import rasterize
from render.launch import upload
from scenes.camera import Camera
from scenes.gaussians import Gaussians, Placed, SplatModel
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

    def select(self, which: torch.Tensor, sh_count: int) -> Splats:
        """Copies of the splats at rising indices `which`, with the first `sh_count` coefficients, for a step to differentiate."""
        fields = {k: (v[:, :sh_count] if k == "sh" else v).detach().index_select(0, which).requires_grad_() for k, v in self.fields.items()}
        ends = torch.searchsorted(which, upload(torch.tensor(self.sizes).cumsum(0), which.device))
        return Splats(fields, ends.diff(prepend=ends.new_zeros(1)).tolist(), self.reach.index_select(0, which))

    def held(self, which: torch.Tensor, names: Sequence[str]) -> Splats:
        """The same splats, of which some, bool `[N]`, are not differentiated by these fields."""
        of = {name: self.fields[name] for name in names}
        still = {name: torch.where(which.view(-1, *[1] * (field.ndim - 1)), field.detach(), field) for name, field in of.items()}
        return Splats(self.fields | still, self.sizes, self.reach)

    def group_of(self) -> torch.Tensor:
        """Group index `[N]` of every splat."""
        return torch.repeat_interleave(torch.arange(len(self.sizes)), torch.tensor(self.sizes)).to(self.reach.device)


def small_poses(deltas: torch.Tensor) -> torch.Tensor:
    """Poses `[..., 4, 4]` of small motions `[..., 6]`: rotation vector (radians), then translation (metres), by the exponential map."""
    x, y, z, u, v, w = deltas.to(torch.float64).unbind(-1)
    o = torch.zeros_like(x)
    rows = [torch.stack(r, -1) for r in ([o, -z, y, u], [z, o, -x, v], [-y, x, o, w], [o, o, o, o])]
    return torch.linalg.matrix_exp(torch.stack(rows, -2))


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


MODEL = SplatModel(projection="ewa")
"""What is trained: EWA costs less than UT, and splats this small look the same under both."""


def draw(
    placed: list[Placed], camera: Camera, *outputs: str, features: list[torch.Tensor] | None = None, scale: float = 1.0
) -> list[torch.Tensor]:
    """The named outputs of one picture under `MODEL`; features `[N, C]` of each of the placed. scale: how large the picture is to those
    that the finished splats are fitted to."""
    frame = rasterize(placed, camera, outputs, model=MODEL.at_scale(scale), features=features)
    return [getattr(frame, name) for name in outputs]


def placed_groups(groups: list[Gaussians], poses: dict[int, torch.Tensor]) -> list[Placed]:
    """The background, and the actors that have a pose; the instance is the group's index."""
    world = torch.eye(4, dtype=torch.float64)
    return [Placed(groups[0], world)] + [Placed(groups[i], pose, instance=i) for i, pose in poses.items()]
