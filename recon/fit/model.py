"""The splats of a fit, those of the background and of all actors together, and how they are rendered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from render import rasterize
from render.launch import upload
from scenes.camera import Camera
from scenes.gaussians import Gaussians, Placed, SplatModel
from scenes.harmonics import brighter

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


def dimmed_actors(splats: Splats, gain: torch.Tensor | None) -> Splats:
    """The splats of all groups, those of actors so much less bright as cameras were exposed more, by a gain `[3]`; as they are where that
    is None."""
    if gain is None:
        return splats
    sh, still = splats.fields["sh"], splats.sizes[0]
    return splats.changed(sh=torch.cat([sh[:still], brighter(sh[still:], 1 / gain.to(sh))]))


def street_alone(placed: Sequence[Placed]) -> list[Placed]:
    """The same, but only the background is differentiated: what another car hides of a mover is held by nothing else, and asked to close
    gaps it would stretch into streaks."""
    return [p if p.instance == 0 else p.detach() for p in placed]


MODEL = SplatModel(projection="ewa")
"""What is trained: EWA costs less than UT, and splats this small look the same under both."""


def draw(
    placed: list[Placed], camera: Camera, *outputs: str, features: list[torch.Tensor] | None = None, scale: float = 1.0
) -> list[torch.Tensor]:
    """The named outputs of one picture under `MODEL`; features `[N, C]` of each of the placed. scale: how large the picture is to those
    that the finished splats are fitted to."""
    frame = rasterize(placed, camera, outputs, model=MODEL.at_scale(scale), features=features)
    return [getattr(frame, name) for name in outputs]
