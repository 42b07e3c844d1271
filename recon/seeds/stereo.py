"""Pictures as pinhole cameras see them, and what they are compared by: normalised cross-correlation in squares."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F

from scenes.camera import Camera
from scenes.poses import inverse

WIDTH = 256
"""Columns at which pictures are compared, at most."""

WINDOW = 5
"""Side of the squares that are correlated, in pixels."""

FLAT = 2.0
"""Levels of 255 of noise: squares whose contrast is not above it look like nothing in particular."""

GREY = 128.0
"""Level that plates count from: sums of squares lose less."""

UNSEEN = 0.7
"""What it costs to be where no other picture looks: less than to be far away, where all look, and look like nothing there."""


@dataclass(frozen=True)
class Plate:
    """A picture as a pinhole camera sees it: grey levels `[h, w]` float32 less `GREY`, focal length and centre in pixels, `cam_from_world`
    `[4, 4]`.

    at: where its pixels lie in the picture that it was made from, `[h, w, 2]` in that one's pixels; `inside` `[h, w]` whether they do.
    """

    grey: torch.Tensor
    focal: tuple[float, float]
    centre: tuple[float, float]
    cam_from_world: np.ndarray
    at: torch.Tensor
    inside: np.ndarray

    def contrast(self) -> np.ndarray:
        """Standard deviation `[h, w]` of the grey levels in the squares that are compared, noise taken off, in parts of their mean."""
        mean, spread = moments_of(self.grey[None])
        return ((spread.square() - FLAT * FLAT).clamp_min(0).sqrt() / (mean + GREY).clamp_min(1))[0].numpy()

    def pixels_from_cam(self) -> np.ndarray:
        """`[3, 3]`, 0 the middle of the first pixel."""
        (fx, fy), (cx, cy) = self.focal, self.centre
        return np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])

    def rays(self) -> torch.Tensor:
        """Directions `[h, w, 3]` of its pixels, z = 1."""
        h, w = self.grey.shape
        y, x = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
        return torch.stack([(x - self.centre[0]) / self.focal[0], (y - self.centre[1]) / self.focal[1], torch.ones_like(x)], -1)

    def columns(self, part: slice) -> Plate:
        """Its grey levels in some columns alone, as `unlike` takes them."""
        return replace(self, grey=self.grey[:, part], centre=(self.centre[0] - part.start, self.centre[1]))

    def points(self, depth: np.ndarray) -> np.ndarray:
        """Where its pixels are in the world at a depth z `[h, w]`, `[h, w, 3]`."""
        back = np.linalg.inv(self.cam_from_world)
        return (self.rays().double().numpy() * depth[..., None]) @ back[:3, :3].T + back[:3, 3]

    def eye(self) -> np.ndarray:
        """Where it was taken, `[3]` in the world."""
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]

    def axis(self) -> np.ndarray:
        """The direction `[3]` in which it looks."""
        return self.cam_from_world[2, :3]

    def shown(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Row, column, depth z and whether in view, each `[...]`, of world points `[..., 3]`; row and column are 0 where not in view."""
        local = points @ self.cam_from_world[:3, :3].T + self.cam_from_world[:3, 3]
        z = local[..., 2]
        before = z > 1e-3
        x, y = (local[..., k] / np.where(before, z, 1.0) * self.focal[k] + self.centre[k] for k in (0, 1))
        inside = before & (x >= 0) & (y >= 0) & (x < self.grey.shape[1]) & (y < self.grey.shape[0])
        return np.where(inside, y, 0).astype(np.int64), np.where(inside, x, 0).astype(np.int64), z, inside


def plate_of(image: torch.Tensor, camera: Camera) -> Plate:
    """The plate of an image `[H, W, 3]` uint8 of a camera of its size: no more than `WIDTH` wide, its lens undone."""
    shrink = min(1.0, WIDTH / camera.width)
    w, h = max(16, round(camera.width * shrink)), max(16, round(camera.height * shrink))
    small = camera.resized(w, h)
    grey = F.interpolate(image.float().mean(2)[None, None], (h, w), mode="area") - GREY
    focal = small.lens.focal()
    plate = Plate(grey[0, 0], (float(focal[0]), float(focal[1])), (w / 2, h / 2), inverse(camera.world_from_cam).numpy(), grey, np.ones(0))
    rays = plate.rays().double()
    at = small.lens.project(rays).float()
    inside = small.lens.valid(rays) & (at > 0).all(-1) & (at[..., 0] < w) & (at[..., 1] < h)
    grid = 2 * at / torch.tensor([w, h]) - 1
    shown = F.grid_sample(grey, grid.nan_to_num(9.0)[None], mode="bilinear", padding_mode="border", align_corners=False)[0, 0]
    scale = torch.tensor([camera.width / w, camera.height / h])
    return Plate(shown, plate.focal, plate.centre, plate.cam_from_world, at * scale, inside.numpy())


def box_means(maps: torch.Tensor, window: int = WINDOW) -> torch.Tensor:
    """Means over squares of a side of maps `[N, h, w]`."""
    half = window // 2
    for axis in (1, 2):
        size = maps.shape[axis]
        first, last = maps.narrow(axis, 0, 1), maps.narrow(axis, size - 1, 1)
        wide = torch.cat([*[first] * half, maps, *[last] * half], axis)
        maps = wide.narrow(axis, 0, size).clone()
        for shift in range(1, window):
            maps += wide.narrow(axis, shift, size)
    return maps.mul_(1 / window**2)


def moments_of(maps: torch.Tensor, window: int = WINDOW) -> tuple[torch.Tensor, torch.Tensor]:
    """Means and standard deviations over squares, the latter with noise."""
    mean = box_means(maps, window)
    return mean, (box_means(maps * maps, window) - mean * mean).clamp_min(0).add(FLAT * FLAT).sqrt()
