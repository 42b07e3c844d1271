"""What the seam alone says of an object's colours: the change with which surfaces go on across it, by robust least squares.

Where a mask reaches beyond its object, or cuts through a wall or a road, the same surface lies on both sides of the seam, and what its
colours jump by is the damage itself. That holds on streets that no network has seen. The network's guess is where the fit begins and what
it is drawn to: the more, the less profiles agree, as round an object that ends where its mask does. Seeing little of a change and much
noise is weighed by what changes are usual (a Gaussian, of training objects).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from enhance.correcting.objects import COEFFICIENTS, LUMA, Box, Objects

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
        (`objects.reaching_over`). As far as the jump at the edge is undone, what is in other colours ends there, and its surface goes on.
        Else both show what an object and its ground differ by, each by other pixels, and the smaller change is nearer to the truth."""
        least = min(beyond, self, key=lambda fit: fit.by).coefficients
        return torch.lerp(least, self.coefficients, self.undoes), (1 - self.undoes) * max(self.ends, beyond.ends)


def fitted(rgb: torch.Tensor, ids: torch.Tensor, i: int, edges: torch.Tensor, box: Box, guess: torch.Tensor, usual: torch.Tensor) -> Fit:
    """The change that object `i` needs, by its seam.

    rgb, ids  `[3, h, w]` and `[h, w]`: the box's outer part
    edges     `[E, 4]`: pixels at the object's seam there, and the way out (`Spots.edges`)
    guess     `[15]`, which is returned where the seam has too few profiles to say anything; they do not say that it ends, either
    usual     `[15, 15]`: a root of the covariance of what objects need (`usual_changes`); of zeros, the guess is kept
    """
    inside, outside, row, texture = _profiles(rgb, ids, i, edges)
    if len(inside) < FEWEST_PROFILES:
        return Fit(guess, float("inf"), 0.0, 0.0)
    height = box.placed(row + box.outer_rows.start, torch.zeros_like(row))[:, 0]
    does = effects(inside, height)
    found, off = _robust(does @ usual, outside - inside - does @ guess)
    coefficients = guess + usual @ found
    jump = (outside - inside).square().mean(1).median()
    undoes = _fall(float((off.median() / jump.clamp_min(1e-9)).sqrt()), UNDONE, STAYS)
    ends = _ends(off, texture) * (1 - _fall(len(inside), UNTOLD, TOLD))
    return Fit(coefficients, float((does @ coefficients).square().mean().sqrt()), undoes, ends)


def _ends(off: torch.Tensor, texture: torch.Tensor) -> float:
    """How surely an object ends, by the mean squares `[N]` that its profiles still differ by and differences `[M, 3]` in what is around."""
    usual = float(texture.square().mean(1).median().sqrt()) if len(texture) >= FEWEST_PROFILES else 0.0
    return 1 - _fall(float(off.median().sqrt()) / max(usual, EVEN), GOES_ON, ENDS)


def _fall(x: float, start: float, end: float) -> float:
    """1 up to `start`, 0 from `end`."""
    return min(1.0, max(0.0, (end - x) / (end - start)))


def _robust(does: torch.Tensor, missing: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """How much of each usual change `[15]`, by what each of them does to colours `[N, 3, 15]` and what these miss `[N, 3]`; and the mean
    squares `[N]` that are left. Reweighted least squares (Cauchy's), for a spread that the profiles themselves show."""
    flat, missing = does.flatten(0, 1), missing.flatten()
    pull = PULL * torch.eye(COEFFICIENTS, device=does.device)
    off = missing.new_zeros(len(does))
    spread = missing.view(-1, 3).square().mean(1).median().clamp_min(EXACT**2)
    for _ in range(ROUNDS):
        weighted = flat / (off + spread).repeat_interleave(3)[:, None]
        found = torch.linalg.solve(weighted.T @ flat + pull, weighted.T @ missing)
        off = (flat @ found - missing).view(-1, 3).square().mean(1)
        spread = (1.5 * off.median()).clamp_min(EXACT**2)
    return found, off


def _profiles(rgb: torch.Tensor, ids: torch.Tensor, i: int, edges: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Colours inside and outside the seam `[N, 3]`, of profiles that lie in the picture and meet no other object; their rows `[N]`; and
    what colours change by from there to further out `[M, 3]`, where that meets none either."""
    h, w = ids.shape
    edges = edges[torch.arange(min(PROFILES, len(edges)), device=edges.device) * len(edges) // PROFILES] if len(edges) > PROFILES else edges
    off = torch.tensor(OFF, device=edges.device)
    steps = torch.cat([-off, 1 + off, 1 + FURTHER + off])
    y, x = edges[:, :1] + steps * edges[:, 2:3], edges[:, 1:2] + steps * edges[:, 3:]
    there = (y >= 0) & (y < h) & (x >= 0) & (x < w)
    y, x = y.clamp(0, h - 1), x.clamp(0, w - 1)
    free = (there & (ids[y, x] <= 0)).unflatten(1, (3, len(OFF))).all(2)
    clear = (there & (ids[y, x] == i))[:, : len(OFF)].all(1) & free[:, 1]
    inside, outside, further = rgb[:, y[clear], x[clear]].permute(1, 2, 0).unflatten(1, (3, len(OFF))).mean(2).unbind(1)
    return inside, outside, edges[clear, 0], (further - outside)[free[clear, 2]]


def effects(rgb: torch.Tensor, height: torch.Tensor) -> torch.Tensor:
    """What a unit of each coefficient adds to `rgb` `[N, 3]` at `height` `[N]`, as `objects.changed` does: `[N, 3, 15]`."""
    luma = (rgb @ rgb.new_tensor(LUMA))[:, None]
    each = torch.stack([torch.ones_like(rgb), rgb, rgb * rgb, luma - rgb, height[:, None] * rgb], -1)
    return (each[:, :, :, None] * torch.eye(3, device=rgb.device)[:, None]).flatten(2)


def usual_changes(objects: Objects) -> torch.Tensor:
    """The root of the covariance, about zero, of the coefficients that B objects need: lower triangular `[15, 15]`."""
    needed = []
    for given, target, height in zip(objects.given, objects.target, objects.height, strict=True):
        does = effects(given, height).flatten(0, 1)
        weak = 1e-4 * len(given) * torch.eye(COEFFICIENTS)
        needed.append(torch.linalg.solve(does.T @ does + weak, does.T @ (target - given).flatten()))
    k = torch.stack(needed)
    return torch.linalg.cholesky(k.T @ k / len(k) + 1e-5 * torch.eye(COEFFICIENTS))
