"""How much of the light a camera shows over its picture, found on the way: by what its renders are off in the mean of many.

Lenses darken corners (Goldman and Chen 2005, "Vignette and exposure calibration and compensation"), and the sun glares on them, in the same
place of every picture. Where two cameras meet, the sky would show the one's corner as a step in the other's picture, and splats near by
would take colours between both.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F

from render.flat_field import in_flat_field

ACROSS = 16
"""Cells across a picture; it has as many down as keep them square."""

SAMPLES = 240
"""Pixels of a row that are compared."""

BEGINS, EVERY = 0.1, 0.04
"""Parts of the fit after which it is asked first, and then again."""

FOLLOWS = 0.5
"""Of what renders are off by, what is taken at once: the splats move as well."""

ALIKE = 0.1
"""Pixels of which a colour is farther off than this show something else than what is rendered."""

FEWEST = 5
"""Training pictures that a camera needs: what renders of one are off by is the street's."""

BRIGHT = 0.97
"""Colours from which on a picture may be clipped."""

DOUBT = 50.0
"""White pixels that are right, for every cell: one of which little is seen stays as it is."""

MOST = 4.0
"""How many times darker or brighter than on average a part of a picture may be: what is black in all of them is no lens's doing."""

SEEN = 0.01
"""A field that nowhere changes more than this part of the light is left out of the scene."""


class FlatField:
    """One camera's: gains `[h, w, 3]`, of geometric mean 1 a channel, and sums `[2, h, w, 3]` of what was rendered and recorded since they
    last changed."""

    def __init__(self, gains: torch.Tensor):
        self.gains, self.sums = gains, torch.zeros(2, *gains.shape, device=gains.device)

    @staticmethod
    def even(width: int, height: int, device: torch.device) -> FlatField:
        """Of a camera that shows all of its picture `[height, width]` alike."""
        return FlatField(torch.ones(max(1, round(ACROSS * height / width)), ACROSS, 3, device=device))

    def found(self) -> torch.Tensor | None:
        """The gains on the host; None where the camera shows all of its picture alike."""
        return self.gains.cpu() if bool((self.gains.log().abs() > SEEN).any()) else None

    def over(self, rgb: torch.Tensor) -> torch.Tensor:
        """A render `[H, W, 3]` in this field."""
        return in_flat_field(rgb, self.gains)

    @torch.no_grad()
    def compare(self, rgb: torch.Tensor, target: torch.Tensor) -> None:
        """Count a render, in this field, and the picture `[H, W, 3]` that it should be."""
        every = max(1, rgb.shape[1] // SAMPLES)
        pair = torch.stack([rgb[::every, ::every], target[::every, ::every]])
        told = ((pair[0] - pair[1]).abs() < ALIKE).all(-1) & (pair < BRIGHT).all(-1).all(0)
        # darker than black, as an exposure may make what is rendered of a night, is black: sums below 0 have no logarithm
        planes = torch.where(told[..., None], pair.clamp_min(0), 0.0).permute(0, 3, 1, 2)
        share = planes[0, 0].numel() / self.gains[..., 0].numel()  # of the pixels, that of a cell
        self.sums += share * F.adaptive_avg_pool2d(planes, (self.gains.shape[0], self.gains.shape[1])).permute(0, 2, 3, 1)

    @torch.no_grad()
    def follow(self) -> None:
        """Take half of what renders were off by."""
        rendered, recorded = blurred(self.sums) + DOUBT
        log = self.gains.log() + FOLLOWS * (recorded / rendered).log()
        # how bright all of its pictures are is the exposure's
        self.gains = (log - log.mean((0, 1))).exp().clamp(1 / MOST, MOST)
        self.sums.zero_()

    def tensors(self) -> list[torch.Tensor]:
        return [self.gains, self.sums]

    def restore(self, state: Sequence[torch.Tensor]) -> None:
        self.gains, self.sums = (t.to(self.gains.device) for t in state)


def due(step: int, steps: int) -> bool:
    """Whether fields follow before a step of a fit."""
    return step >= BEGINS * steps and step % max(1, round(EVERY * steps)) == 0


def blurred(sums: torch.Tensor) -> torch.Tensor:
    """Sums `[2, h, w, 3]`, each cell's with those about it, by a quarter, half and quarter along each side."""
    for side in (1, 2):
        first, last = sums.narrow(side, 0, 1), sums.narrow(side, sums.shape[side] - 1, 1)
        before = torch.cat([first, sums.narrow(side, 0, sums.shape[side] - 1)], side)
        after = torch.cat([sums.narrow(side, 1, sums.shape[side] - 1), last], side)
        sums = 0.25 * before + 0.5 * sums + 0.25 * after
    return sums
