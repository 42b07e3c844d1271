"""The side of a vehicle that no picture shows: the mirror image of the other, or where neither is known its end drawn along it (`flanks`).

A car ahead is half hidden by the one that the recording car follows; what stands there is left of how the fit began, or nothing does, and
from aside that shows. Both are taken where no picture shows them either.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from scipy.spatial import cKDTree

from recon.fit.densify import LARGEST, shade_of
from recon.fit.flanks import flanks
from recon.fit.model import Splats
from recon.fit.unseen import SEEN
from recon.log import Track
from recon.objects.mirror import other_half
from recon.objects.tracks import VEHICLES
from scenes.gaussians import Gaussians

INSTEAD = 0.3
"""Metres from a mirror image or side within which it stands for what no picture shows."""

ROOM = 0.02
"""Of the splat budget that is kept for halves and sides."""


def halves(splats: Splats, part: torch.Tensor, tracks: Sequence[Track]) -> tuple[list[Gaussians], list[torch.Tensor]]:
    """Of each group, the background first, what would complete it, and its reach. part `[N]`: of each splat, what the picture shows that
    shows most of it."""
    groups = [g.to("cpu") for g in splats.groups(splats.fields["sh"].shape[1])]
    reaches, known = splats.reach.split(splats.sizes), (part >= SEEN).cpu().split(splats.sizes)
    more, reach = [g.select(torch.zeros(0, dtype=torch.int64)) for g in groups], [r[:0] for r in reaches]
    for i, track in enumerate(tracks, 1):
        if track.label in VEHICLES and known[i].any():
            mine = groups[i].select(known[i])
            image = other_half(mine, torch.from_numpy(track.size))
            more[i] = Gaussians.cat([image, flanks(Gaussians.cat([mine, image]), track.size, track.label)])
            usual = reaches[i].median()
            reach[i] = torch.maximum(more[i].log_scales.exp().amax(1).to(usual) / LARGEST, usual)
    return more, reach


def outdone(splats: Splats, part: torch.Tensor, old: torch.Tensor, shown: torch.Tensor, budget: int) -> torch.Tensor:
    """Which splats, bool `[N]`, go once halves stand among them: those halves, not `old`, of which a picture shows something by `shown`
    `[N]`, and what no picture shows by `part` `[N]`, but shade, where the others stand. Halves beyond the budget go whole, of what pictures
    show least of first."""
    gone = ~old & (shown >= SEEN)
    hidden = old & (part < SEEN) & ~shade_of(splats)
    means, group = splats.fields["means"].detach().cpu(), splats.group_of()
    room = budget - int(old.sum())
    for i in sorted(range(1, len(splats.sizes)), key=lambda i: -int((old & (part >= SEEN) & (group == i)).sum())):
        stands, behind = ((group == i) & mask for mask in (~old & ~gone, hidden))
        if not stands.any():
            continue
        if behind.any():
            away, _ = cKDTree(means[stands.cpu()].numpy()).query(means[behind.cpu()].numpy())
            behind[behind.clone()] = torch.from_numpy(away < INSTEAD).to(gone.device)
        more = int(stands.sum()) - int(behind.sum())
        gone |= behind if more <= room else stands
        room -= more if more <= room else 0
    return gone
