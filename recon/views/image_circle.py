"""Where a lens's image ends: a fisheye's circle is smaller than the sensor, whose corners stay black.

Taken for street, they are: walls before the camera, a dark sky, and a flat field that darkens all that is near them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from recon.log import LogCamera
from render.rays import camera_rays
from scenes.spread import spread

LOOKS = 48
"""Pictures that are searched, evenly taken."""

DARK, BRIGHT = 12, 40
"""Levels, of the brightest channel in any picture, up to which no light reaches a pixel, and above which some does."""

ALL, MOST, LEAST = 0.98, 0.9, 0.003
"""Parts: of what is beyond the circle that is dark, of the ring within it that is bright, and of the picture that is beyond."""

RING, RIM = (0.94, 0.98), 0.985
"""Of the circle's angle, that ring, and up to which its image is whole: its edge is blurred."""


def image_circle(camera: LogCamera, indices: Sequence[int], picture: Callable[[int], np.ndarray]) -> np.ndarray | None:
    """bool `[H, W]` of what lies beyond the image in a camera's frames `indices`, uint8 `[H, W, 3]` of one size; None where nothing does.

    It is sought as an angle from the axis beyond which all is black in every picture, and within which hardly anything is: a night's
    corners are dark as well, but by and by.
    """
    if not len(indices):
        return None
    some = spread(indices, LOOKS)
    brightest = np.max([picture(i).max(-1) for i in some], 0)
    rays = camera_rays(camera.camera(some[0], *brightest.shape[::-1]))
    angles = torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2]).masked_fill_((rays == 0).all(-1), torch.pi).numpy()
    order = np.argsort(-angles, axis=None)
    dark = np.cumsum(brightest.ravel()[order] <= DARK) / np.arange(1, angles.size + 1)
    enough = np.flatnonzero(dark >= ALL)
    if not len(enough) or enough[-1] < LEAST * angles.size:
        return None
    edge = angles.ravel()[order[enough[-1]]]
    ring = (angles > RING[0] * edge) & (angles < RING[1] * edge)
    return angles > RIM * edge if ring.any() and (brightest[ring] > BRIGHT).mean() >= MOST else None
