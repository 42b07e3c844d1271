"""How many splats, and where: split those that do worst, drop what does not show or leaves its box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from recon.fit.model import FIELDS, Splats
from scenes.gaussians import Gaussians
from scenes.harmonics import sh_from_rgb
from scenes.shade import BLACK

FAINT = 0.02
"""Opacity under which a splat is dropped."""

LARGEST = 0.03
"""Of a splat's reach: its standard deviation at most, 30 pixels."""

THINNEST = 1e-4
"""Of a splat's reach: its standard deviation at least, a tenth of a pixel."""

LONGEST = 12.0
"""Times a splat's middle axis that its longest may be: needles look right along one ray only."""

BOX_MARGIN = 0.25
"""Metres beyond its box that an actor's splat may stand."""

SHADE_MARGIN = 2.0
"""The same of its shade."""


@dataclass
class Growth:
    """What tells where splats are missing, of each splat `[N]`, since the last densification.

    errors: sum of pictures' errors times its weights in them (Bulò et al. 2024, equation 1), of as many pictures as it was `shown` in.
    pull: sum of its place's gradients, of all costs, times its reach (Kerbl et al. 2023, who take pixels), of as many steps as it was
    `pulled` in. What no splat can show better is wrong however many there are, and pulls cancel where a splat is too large for what it
    shows: each alone sends splats where they bring less (tests/bench/reconstruction.md).
    """

    errors: torch.Tensor
    shown: torch.Tensor
    pull: torch.Tensor
    pulled: torch.Tensor

    @staticmethod
    def none(count: int, device: torch.device | str = "cpu") -> Growth:
        return Growth(*torch.zeros(4, count, device=device))

    def blame(self, which: torch.Tensor, errors: torch.Tensor) -> None:
        """What is wrong `[M]` in one more picture where splats `which` `[M]` show."""
        self.errors.index_add_(0, which, errors)
        self.shown.index_add_(0, which, (errors > 0).to(errors))

    def need(self) -> torch.Tensor:
        """How much each splat `[N]` is in need of another: the geometric mean of error and pull in the mean picture."""
        return (self.errors / self.shown.clamp_min(1) * self.pull / self.pulled.clamp_min(1)).sqrt()

    def tensors(self) -> dict[str, torch.Tensor]:
        return {"errors": self.errors, "shown": self.shown, "pull": self.pull, "pulled": self.pulled}


def grow(
    splats: Splats,
    carried: dict[str, torch.Tensor],
    growth: Growth,
    budget: int,
    rounds_left: int,
    boxes: list[np.ndarray],
    astray: torch.Tensor | None = None,
) -> tuple[Splats, dict[str, torch.Tensor]]:
    """Splats after one round, and what each carries with it, `[N, ...]`, of which new splats start with zeros.

    Dropped: fainter than `FAINT`, outside their actor's box, `astray` (bool `[N]`). Split: those in most `need`, as many as make the budget
    last `rounds_left` rounds, in two along their longest axis.
    """
    fields = {k: v.detach() for k, v in splats.fields.items()}
    group = splats.group_of()
    keep = (torch.sigmoid(fields["logits"]) > FAINT) & _within(fields["means"], group, boxes, _shade(fields["sh"]))
    if astray is not None:
        keep &= ~astray
    need = torch.where(keep, growth.need(), 0.0)
    count = min(max(0, (budget - int(keep.sum())) // rounds_left), int((need > 0).sum()))
    parents = need.topk(count).indices if count else torch.zeros(0, dtype=torch.long, device=need.device)

    scales = fields["log_scales"][parents]
    axis = scales.argmax(1)
    direction = _axes(fields["quats"][parents], axis)
    offset = direction * (0.5 * scales.exp().amax(1))[:, None]
    smaller = scales - 0.1
    smaller[torch.arange(count, device=axis.device), axis] = scales.amax(1) + float(np.log(0.6))
    children = {k: fields[k][parents] for k in FIELDS}
    children["means"] = fields["means"][parents] - offset
    children["log_scales"] = smaller
    fields["means"] = fields["means"].index_add(0, parents, offset)
    fields["log_scales"] = fields["log_scales"].index_copy(0, parents, smaller)

    old_ones = keep.nonzero()[:, 0]
    order = torch.argsort(torch.cat([group[old_ones], group[parents]]), stable=True)

    def assembled(old: torch.Tensor, new: torch.Tensor) -> torch.Tensor:
        return torch.cat([old[old_ones], new])[order]

    after = {k: assembled(fields[k], children[k]) for k in FIELDS}
    sizes = torch.bincount(assembled(group, group[parents]), minlength=len(splats.sizes)).tolist()
    carried = {k: assembled(t, torch.zeros_like(t[parents])) for k, t in carried.items()}
    return Splats(after, sizes, assembled(splats.reach, splats.reach[parents])), carried


def kept(splats: Splats, carried: dict[str, torch.Tensor], which: torch.Tensor) -> tuple[Splats, dict[str, torch.Tensor]]:
    """The splats of a mask `[N]`, and what each of them carries with it."""
    fields = {k: v.detach()[which] for k, v in splats.fields.items()}
    sizes = torch.bincount(splats.group_of()[which], minlength=len(splats.sizes)).tolist()
    return Splats(fields, sizes, splats.reach[which]), {k: t[which] for k, t in carried.items()}


def joined(
    splats: Splats, carried: dict[str, torch.Tensor], more: Sequence[Gaussians], reach: Sequence[torch.Tensor]
) -> tuple[Splats, dict[str, torch.Tensor]]:
    """The splats, and `more` of each group, the background first, behind those that it has; reach `[M]` of each. What the new ones carry
    with them is zeros."""
    new = Splats.of(list(more), list(reach)).to(splats.reach.device)
    groups = torch.cat([splats.group_of(), new.group_of()])
    order = torch.argsort(groups, stable=True)
    after = {k: torch.cat([v.detach(), new.fields[k]])[order] for k, v in splats.fields.items()}
    carried = {k: torch.cat([t, t.new_zeros(len(new), *t.shape[1:])])[order] for k, t in carried.items()}
    sizes = torch.bincount(groups, minlength=len(splats.sizes)).tolist()
    return Splats(after, sizes, torch.cat([splats.reach, new.reach])[order]), carried


def _within(means: torch.Tensor, group: torch.Tensor, boxes: list[np.ndarray], shade: torch.Tensor) -> torch.Tensor:
    """Mask of splats that stand in their actor's box, or around it, if they are its shade; the background has none."""
    half = torch.tensor(np.array([[np.inf] * 3, *[[s[0] / 2, s[1] / 2, s[2]] for s in boxes]]), dtype=torch.float32)
    half = half.to(group.device)[group]
    margin = torch.where(shade, SHADE_MARGIN, BOX_MARGIN)[:, None]
    inside = (means[:, :2].abs() <= half[:, :2] + margin).all(1) & (means[:, 2] <= half[:, 2] + BOX_MARGIN)
    return inside & ((means[:, 2] >= -BOX_MARGIN) | (group == 0))


def _shade(sh: torch.Tensor) -> torch.Tensor:
    """Mask `[N]` of the colours `[N, K, 3]` that shade is laid with, and keeps where it is held; what else strays from a box has others."""
    return (sh.detach()[:, 0] == sh_from_rgb(BLACK)).all(1)


def shade_of(splats: Splats) -> torch.Tensor:
    """Which splats, bool `[N]`, are the shade that actors take along."""
    black = _shade(splats.fields["sh"])
    black[: splats.sizes[0]] = False
    return black


def hold_shade(shown: Splats, which: torch.Tensor) -> None:
    """Take from the shade among splats, bool `[N]`, the gradients that would move, turn, stretch or colour it: it lies where and as it was
    laid, and darkens what is below by its opacity alone. Free to, some stood up and passed from the recorded path for what is behind it,
    some took the colour of a tail light, or of nothing that there is."""
    for name in ("means", "quats", "log_scales", "sh"):
        gradient = shown.fields[name].grad
        if gradient is not None:
            gradient.masked_fill_(which.view(-1, *[1] * (gradient.ndim - 1)), 0)  # unlike an index, this does not wait for the device


def _axes(quats: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
    """The world direction `[N, 3]` of each splat's `axis`th axis."""
    from scenes.poses import matrix_from_quat

    return matrix_from_quat(quats).gather(2, axis[:, None, None].expand(-1, 3, 1))[..., 0]
