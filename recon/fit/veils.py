"""Removes what hangs before things that move, where no lidar looked through: from the recorded path splats on the line of sight to a car
look just as it does, and are a ghost from beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from recon.fit.model import Splats
from recon.ground import above_ground
from recon.log import Track
from recon.seeds.points import nearest_box
from recon.views.project import project
from scenes.camera import Camera
from scenes.ground import Ground
from scenes.poses import inverse

FAR = 30.0
"""Metres up to which it is asked what is before a box."""

AHEAD = 0.5, 0.05
"""Metres, and parts of its distance, by which something must be nearer than a box to hang before it."""

ABOVE = 0.3
"""Metres above the ground from which on something hangs."""

PART = 0.3
"""Part of the pictures that show it, each by how large it is there, in which it hangs before a box: what stands there is seen before other
things, too."""


@dataclass(frozen=True)
class Veils:
    """Pictures' cameras, those that show `tracks` of what moves within `FAR` and the others, and a ground."""

    showing: Sequence[Camera]
    others: Sequence[Camera]
    tracks: list[Track]
    ground: Ground

    @staticmethod
    def of(cameras: Sequence[Camera], tracks: Sequence[Track], ground: Ground) -> Veils:
        """Of pictures' cameras, and what moves."""
        moving = [track for track in tracks if track.moving]
        shows = [bool((nearest_box(camera, moving) < FAR).any()) for camera in cameras]
        showing, others = ([c for c, there in zip(cameras, shows, strict=True) if there == asked] for asked in (True, False))
        return Veils(showing, others, moving, ground)

    def holds(self, splats: Splats) -> torch.Tensor:
        """Mask `[N]` of the splats of the background that hang before boxes."""
        mask = torch.zeros_like(splats.reach, dtype=torch.bool)
        if not self.showing:
            return mask
        means = splats.fields["means"][: splats.sizes[0]].detach().double().cpu().numpy()
        high = np.flatnonzero(above_ground(means, self.ground) > ABOVE)
        shown, before = np.zeros((2, len(high)))
        for camera in self.showing:
            row, column, away, large = _seen(means[high], camera)
            near = nearest_box(camera, self.tracks)[row, column]
            shown += large
            before += large * ((near < FAR) & (away < near * (1 - AHEAD[1]) - AHEAD[0]))
        some = before > 0
        high, shown, before = high[some], shown[some], before[some]
        for camera in self.others:
            shown += _seen(means[high], camera)[3]
        mask[torch.from_numpy(high[before > PART * shown]).to(mask.device)] = True
        return mask


def _seen(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Row, column and depth of points `[N, 3]` in a picture, and how large each is there, by its nearness squared; 0 where hardly seen."""
    row, column, away, inside = project(points, inverse(camera.world_from_cam).numpy(), camera)
    return row, column, away, (inside & (away < 2 * FAR)) / np.maximum(away, AHEAD[0]) ** 2
