"""Removes splats where lidar looked through. From the recorded path splats in the air may look right, as a car that passes its camera, or
what a picture's border cuts off; from beside it they are ghosts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from recon.fit.model import Splats
from recon.ground import above_ground
from recon.log import Log, Track
from recon.movers.freespace import RangeImage, range_images
from recon.objects.actors import SWEPT_MARGIN, inside
from scenes.ground import Ground
from scenes.poses import inverse
from scenes.spread import spread

LOOKS = 24
"""Sweeps, spread over the drive, that are asked."""

THROUGH, THERE = 4, 0.1
"""Sweeps of a lidar that must have looked through a place for it to be clear, and times those that at most saw something there."""

ABOVE = 0.3
"""Metres above the ground from which on places are looked at: along a road beams say little."""

FAR = 60.0
"""Metres from a lidar up to which it is asked."""


@dataclass(frozen=True)
class Clear:
    """What lidars saw of the space above a ground."""

    images: Sequence[RangeImage]
    ground: Ground

    @staticmethod
    def of(log: Log, span_us: tuple[int, int], ground: Ground) -> Clear:
        """By some of a log's sweeps within a span of time. What they struck of what moves is not there."""
        images, movers = [], [track for track in log.tracks if track.moving]
        for sweep in spread(log.sweeps_within(span_us), LOOKS):
            points = sweep.read()
            moves = points.xyz[_in_boxes(points.xyz, movers, sweep.time_us)]
            images += [image.without(moves) for _, image in range_images(log, [(sweep.time_us, points)])]
        return Clear(images, ground)

    def struck(self, points: np.ndarray) -> np.ndarray:
        """Whether more than `THERE` of the sweeps saw something where points `[N, 3]` are; bool `[N]`, of none where there is no lidar."""
        there = np.zeros(len(points), np.int64)
        for image in self.images:
            there += image.votes(points)[1]
        return there > THERE * len(self.images)

    def holds(self, splats: Splats) -> torch.Tensor:
        """Mask `[N]` of the splats of the background whose middles lie where lidars looked through."""
        mask = torch.zeros_like(splats.reach, dtype=torch.bool)
        middles = splats.fields["means"][: splats.sizes[0]].detach().double().cpu().numpy()
        mask[: splats.sizes[0]] = torch.from_numpy(self.seen_through(middles)).to(mask.device)
        return mask

    def seen_through(self, points: np.ndarray) -> np.ndarray:
        """Whether points `[N, 3]` lie where lidars looked through; bool `[N]`."""
        above = above_ground(points, self.ground)
        asked = np.flatnonzero(above > ABOVE)
        through, there = np.zeros((2, len(asked)), np.int64)
        for image in self.images:
            near = np.flatnonzero(np.linalg.norm(points[asked] - image.middle, axis=1) < FAR)
            beyond, struck = image.votes_with_silence(points[asked[near]])
            through[near] += beyond
            there[near] += struck
            left = there <= THERE * len(self.images)  # others have been struck too often, whatever is still to come
            asked, through, there = asked[left], through[left], there[left]
        found = np.zeros(len(points), bool)
        found[asked[(through >= THROUGH) & (there <= THERE * through)]] = True
        return found


def _in_boxes(xyz: np.ndarray, tracks: Sequence[Track], time_us: int) -> np.ndarray:
    """Whether points `[N, 3]` are in the boxes of tracks at a time, or next to them: bool `[N]`."""
    within = np.zeros(len(xyz), bool)
    for track in tracks:
        path = track.trajectory()
        if path.covers(time_us):
            back = inverse(path.at(time_us)).numpy()
            within |= inside(xyz @ back[:3, :3].T + back[:3, 3], track.size, SWEPT_MARGIN)
    return within
