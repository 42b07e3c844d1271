"""What pictures never show, by example: the wall behind a tree, which only a camera beside the path looks at.

There a fit has few and large splats, in the mean colour of what is around (`recon/fit/unseen.py`): a blur between sharp things. Each is
replaced by copies of splats beside it that pictures do show, as inpainting copies patches of a picture (Criminisi et al. 2004), so that
leaves go on as leaves and a wall as a wall. That is plausible, not true.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from scipy.spatial import cKDTree

from recon.fit.densify import joined, kept
from recon.fit.fit import Fit
from recon.fit.motion import Shot
from recon.fit.unseen import LOW, SEEN, off_ground
from scenes.gaussians import Gaussians
from scenes.poses import matrix_from_quat
from scenes.spread import spread

LOOKS, BESIDE = 10, (-1.0, -0.5, 0.5, 1.0)
"""Pictures of each camera that are taken again from beside the path, and where: in parts to the left of `Openings.metres`."""

KNOWN = 0.2
"""Part of a splat that a picture must show for it to be an example."""

COARSER = 3.0
"""Times as large as what is around a splat must be to be a blur there."""

AROUND, NEAR = 12, 3.0
"""Splats around one, whose middle size and colour are those of what is there, and metres within which the first of them must be."""

FILLED, MOST = 1.5, 24
"""Size of its copies together, as a part of a splat's own, and how many these are at most."""

AMONG = 4
"""Most like the middle colour of the `AROUND` nearest to its own place, of which a copy is any one: of the nearest alone there would be
rows of the same, and of one that is unlike what it lies among there would be dots."""

WITHIN = 1.6
"""Standard deviations of the splat within which its copies lie."""


def background(fit: Fit) -> Gaussians:
    """A fit's splats of the background by now, on the host; of one that is done with what only cameras beside the path see, by example.

    Copies of which pictures show something are left out, and a splat stays that would lose more than half of its copies so.
    """
    splats = fit.splats.groups(fit.sh_count())[0].detach().to("cpu")
    if fit.progress < 1:
        return splats
    path, aside = fit.shown().part, fit.shown_by(_looks(fit)).part
    stands = off_ground(fit.splats, fit.population.ground) > LOW
    hidden, known = ((which & stands)[: len(splats)].cpu() for which in ((path < SEEN) & (aside >= SEEN), path >= KNOWN))
    copies, of = by_example(splats, hidden, known, fit.config.seed)
    if not len(copies):
        return splats

    goes = torch.zeros(len(path), dtype=torch.bool)
    goes[of] = True
    rest, _ = kept(fit.splats, {}, ~goes.to(path.device))
    whole, _ = joined(rest, {}, [copies], [fit.splats.reach[of.to(path.device)].cpu()])
    fine = (fit.shown(whole).part[rest.sizes[0] : whole.sizes[0]] < SEEN).cpu()
    goes &= 2 * of[fine].bincount(minlength=len(path)) > of.bincount(minlength=len(path))
    stays = (~goes[: len(splats)]).nonzero()[:, 0]
    return Gaussians.cat([splats.select(stays), copies.select((fine & goes[of]).nonzero()[:, 0])])


def _looks(fit: Fit) -> Iterator[Shot]:
    for c in range(len(fit.frames.names)):
        for view in spread([v for v in fit.training if v.camera == c], LOOKS):
            shot = fit.coarse(view)
            for part in BESIDE:
                yield fit.motion.beside(shot, fit.openings.aside(view, shot.camera, part * fit.openings.metres))


def by_example(splats: Gaussians, hidden: torch.Tensor, known: torch.Tensor, seed: int) -> tuple[Gaussians, torch.Tensor]:
    """Copies of the splats `[N]` that are `known`, bool `[N]`, to stand for those `hidden` that are coarser than these are around them, and
    the index of the one that each stands for.

    Copies keep size, rotation and opacity, and of their colour what does not turn with the view.
    """
    examples, which = known.nonzero()[:, 0], hidden.nonzero()[:, 0]
    if len(examples) < AROUND or not len(which):
        return splats.select(which[:0]), which[:0]
    tree = cKDTree(splats.means[examples].numpy())
    away, around = tree.query(splats.means[which].numpy(), AROUND)
    large = splats.log_scales.topk(2, 1).values.sum(1).exp()  # as seen from where it is widest, but for a constant
    ratio = large[which] / large[examples][torch.from_numpy(around)].median(1).values
    blurs = (ratio > COARSER) & torch.from_numpy(away[:, 0] < NEAR)

    generator = torch.Generator().manual_seed(seed)
    of = which[blurs].repeat_interleave((FILLED * ratio[blurs]).clamp_max(MOST).round().long())
    spread = splats.log_scales[of].exp() * torch.randn(len(of), 3, generator=generator).clamp(-WITHIN, WITHIN)
    means = splats.means[of] + (matrix_from_quat(splats.quats[of]) @ spread[:, :, None])[:, :, 0]
    nearest = torch.from_numpy(tree.query(means.numpy(), AROUND)[1])
    looks = splats.sh[examples, 0][nearest]
    unlike = (looks - looks.median(1, keepdim=True).values).square().sum(2)
    any_one = torch.randint(0, AMONG, (len(of), 1), generator=generator)
    like = splats.select(examples[nearest.gather(1, unlike.argsort(1).gather(1, any_one))[:, 0]])
    steady = torch.cat([like.sh[:, :1], torch.zeros_like(like.sh[:, 1:])], 1)
    return replace(like, means=means, sh=steady), of
