"""What the seam alone says of an object's colours: the change with which surfaces go on across it, by robust least squares.

Where a mask reaches beyond its object, or cuts through a wall or a road, the same surface lies on both sides of the seam, and what its
colours jump by is the damage itself. That holds on streets that no network has seen. The network's guess is where the fit begins and what
it is drawn to: the more, the less profiles agree, as round an object that ends where its mask does. Seeing little of a change and much
noise is weighed by what changes are usual (a Gaussian, of training objects).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from enhance.correcting.objects import COEFFICIENTS, LUMA, Objects
from enhance.correcting.outlines import Outlines

PROFILES = 512
"""Most profiles across a seam that are read."""
OFF = (1, 2, 3)
"""Pixels beyond those at the seam, which may be mixed, whose mean is a side's colour."""
FEWEST_PROFILES = 24
PULL = 200.0
"""Profiles that the guess is worth, at the usual spread of what it is wrong by. Neighbours say much the same: 30 of them count as one."""
EXACT = 0.02
"""Least spread of what profiles differ by."""
ROUNDS = 5
FURTHER = 5
"""Pixels from a side's colour to the next one on, which are as far apart as the two sides' are."""
EVEN = 6 / 255
"""Least that colours of one surface are taken to differ by."""
GOES_ON, ENDS = 1.2, 1.5
"""What a seam's fit leaves, to what colours as far apart differ by in the surroundings alone: up to the one a surface goes on there, so
that nothing was put in and no shadow is missing, and from the other an object ends. Of regions of photos it is 0.9 to 1.0 in the median and
1.1 to 1.4 in one of twenty, at 320 to 1280 pixels of width alike; of assets put in nearly always 1.5 and more."""
UNDONE, STAYS = 0.6, 0.8
"""What a seam's fit leaves, to what colours jump by there: up to the one, one change is what makes them jump, and from the other it hardly
has to do with it. Of regions of photos in other colours it is 0.2 to 0.5, of right ones 0.9 to 1.0; of assets put in 0.8 to 1.0."""
UNTOLD, TOLD = 48, 96
"""Profiles up to which too little of an object is seen to say that it ends at its seam, and from which there is enough."""


@dataclass(frozen=True)
class Fit:
    """What a seam says of its object.

    coefficients  `[15]` of the change (`objects.changed`) that it needs
    by            root mean square of what that changes at the seam; inf where there are too few profiles to say anything
    undoes        how surely colours jump at the seam by that change, 0 to 1
    ends          how surely a surface ends at the seam, 0 to 1
    """

    coefficients: torch.Tensor
    by: float
    undoes: float
    ends: float

    def with_beyond(self, beyond: Fit) -> tuple[torch.Tensor, float]:
        """Coefficients and how surely the object ends, by this seam, of a mask's edge, and by that of a mask a pixel larger
        (`outlines.reaching_over`). As far as the jump at the edge is undone, what is in other colours ends there, and its surface goes on.
        Else both show what an object and its ground differ by, each by other pixels, and the smaller change is nearer to the truth."""
        least = min(beyond, self, key=lambda fit: fit.by).coefficients
        return torch.lerp(least, self.coefficients, self.undoes), (1 - self.undoes) * max(self.ends, beyond.ends)


@dataclass(frozen=True)
class _Profiles:
    """Of S seams, N each: colours inside and outside `[S, N, 3]` and at which height of the box `[S, N]`, of those that are `known`
    `[S, N]`, which lie in the picture and meet no other object; and what colours change by from there to further out `[S, N, 3]`, `[S, N]`
    of which are `told`, as they meet none there either."""

    inside: torch.Tensor
    outside: torch.Tensor
    height: torch.Tensor
    known: torch.Tensor
    texture: torch.Tensor
    told: torch.Tensor


def fitted(rgb: torch.Tensor, objects: Outlines, guesses: torch.Tensor, usual: torch.Tensor) -> list[Fit]:
    """The changes that S objects of a frame `[3, H, W]` need, each by its seam, on the CPU.

    guesses  `[S, 15]`, which are returned where a seam has too few profiles to say anything; they do not say that it ends, either
    usual    `[15, 15]`: a root of the covariance of what objects need (`usual_changes`); of zeros, the guesses are kept
    """
    seen = _profiles(rgb, objects)
    does = effects(seen.inside, seen.height)
    jump = seen.outside - seen.inside
    found, off = _robust(does @ usual, jump - (does @ guesses[:, None, :, None])[..., 0], seen.known)
    coefficients = guesses + found @ usual.T
    by = ((does @ coefficients[:, None, :, None]).square().mean((2, 3)) * seen.known).sum(1) / seen.known.sum(1)
    left, jumps, textures = (
        _median(x, known) for x, known in ((off, seen.known), (_power(jump), seen.known), (_power(seen.texture), seen.told))
    )
    # all at once to where it is decided upon: a GPU would be waited for each time
    facts = torch.stack([seen.known.sum(1), seen.told.sum(1), by, left, jumps, textures], 1).tolist()
    fits = []
    for guess, wanted, (count, told, power, least, most, rough) in zip(guesses.cpu(), coefficients.cpu(), facts, strict=True):
        if count < FEWEST_PROFILES:
            fits.append(Fit(guess, float("inf"), 0.0, 0.0))
            continue
        undoes = _fall((least / max(most, 1e-9)) ** 0.5, UNDONE, STAYS)
        ends = 1 - _fall(least**0.5 / max(rough**0.5 if told >= FEWEST_PROFILES else 0.0, EVEN), GOES_ON, ENDS)
        fits.append(Fit(wanted, power**0.5, undoes, ends * (1 - _fall(count, UNTOLD, TOLD))))
    return fits


def _fall(x: float, start: float, end: float) -> float:
    """1 up to `start`, 0 from `end`."""
    return min(1.0, max(0.0, (end - x) / (end - start)))


def _power(colours: torch.Tensor) -> torch.Tensor:
    """Mean squares `[...]` of `[..., 3]`."""
    return colours.square().mean(-1)


def _median(x: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """`[S]` of those of `x` `[S, N]` that are known; NaN where none is."""
    return x.where(known, torch.nan).nanmedian(1).values


def _robust(does: torch.Tensor, missing: torch.Tensor, known: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """How much of each usual change `[S, 15]`, by what each of them does to colours `[S, N, 3, 15]` and what these miss `[S, N, 3]`, of the
    profiles that are known `[S, N]`; and the mean squares `[S, N]` that are left. Reweighted least squares (Cauchy's), for a spread that
    the profiles themselves show; where none is known, nothing."""
    flat, flat_missing = does.flatten(1, 2), missing.flatten(1)[..., None]
    pull = PULL * torch.eye(COEFFICIENTS, device=does.device)
    off, weighs = missing.new_zeros(missing.shape[:2]), known.to(missing)
    spread = _median(_power(missing), known).nan_to_num().clamp_min(EXACT**2)
    for _ in range(ROUNDS):
        weighted = (flat * (weighs / (off + spread[:, None])).repeat_interleave(3, 1)[..., None]).mT
        found = torch.linalg.solve(weighted @ flat + pull, weighted @ flat_missing)
        off = _power((flat @ found - flat_missing).view_as(missing))
        spread = (1.5 * _median(off, known)).nan_to_num().clamp_min(EXACT**2)
    return found[..., 0], off


def _profiles(rgb: torch.Tensor, objects: Outlines) -> _Profiles:
    """Of all seams, as many for each as the longest has, PROFILES at most."""
    edges, there = objects.seam(max(1, min(PROFILES, max(len(o.edges) for o in objects.each))))
    off = torch.tensor(OFF, device=rgb.device)
    steps = torch.cat([-off, 1 + off, 1 + FURTHER + off])[:, None]
    way = edges[:, :, None, :2] + steps * edges[:, :, None, 2:]
    first, last = objects.first[:, None, None], objects.end[:, None, None] - 1
    inner = ((way >= first) & (way <= last)).all(3)
    y, x = way.clamp(first, last).unbind(3)
    ids = objects.ids(y, x)
    free = (inner & (ids <= 0)).unflatten(2, (3, len(OFF))).all(3)
    known = there & (inner & objects.mine(ids))[..., : len(OFF)].all(2) & free[..., 1]
    inside, outside, further = rgb[:, y, x].movedim(0, -1).unflatten(2, (3, len(OFF))).mean(3).unbind(2)
    return _Profiles(inside, outside, objects.places(edges[..., :2])[..., 0], known, further - outside, known & free[..., 2])


def effects(rgb: torch.Tensor, height: torch.Tensor) -> torch.Tensor:
    """What a unit of each coefficient adds to `rgb` `[..., 3]` at `height` `[...]`, as `objects.changed` does: `[..., 3, 15]`."""
    luma = (rgb @ rgb.new_tensor(LUMA))[..., None]
    each = torch.stack([torch.ones_like(rgb), rgb, rgb * rgb, luma - rgb, height[..., None] * rgb], -1)
    return (each[..., None] * torch.eye(3, device=rgb.device)[:, None]).flatten(-2)


def usual_changes(objects: Objects) -> torch.Tensor:
    """The root of the covariance, about zero, of the coefficients that B objects need: lower triangular `[15, 15]`."""
    needed = []
    for given, target, height in zip(objects.given, objects.target, objects.height, strict=True):
        does = effects(given, height).flatten(0, 1)
        weak = 1e-4 * len(given) * torch.eye(COEFFICIENTS)
        needed.append(torch.linalg.solve(does.T @ does + weak, does.T @ (target - given).flatten()))
    k = torch.stack(needed)
    return torch.linalg.cholesky(k.T @ k / len(k) + 1e-5 * torch.eye(COEFFICIENTS))
