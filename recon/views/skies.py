"""The sky: which pixels show it, its picture by direction, and what of that was truly seen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage

from render import render_frame
from render.rays import camera_rays
from scenes.camera import Camera
from scenes.scene import Scene
from scenes.sky import Sky, linear_from_srgb, srgb_from_linear, texels
from scenes.spread import spread

LOOKS = 12
"""Moments of each camera at which it is found out where light comes from the sky."""

FREE = 0.05
"""Of all looks in a direction, those that must meet nothing for the sky there to be believed."""

HIDDEN = 128
"""Rows of the grid of directions in which the sky is never seen: 1.4 degrees each."""

EVEN = 3.0
"""Levels a pixel by which the sky changes at most, but for clouds' edges."""

TRACE = 1e-3
"""Weight from which on a direction counts as seen."""

COARSE, FALLS, NEAREST = 4, 4, 1e-5
"""Directions a side that are taken together to tell the others; the power of distance by which they tell less, and the least square of it:
0.2 degrees."""

WIRE = 80
"""Of a picture's width, how wide wires are at most."""

RATHER, SPREAD, NEAR = 8.0, 2.5, 4.0
"""Levels by which a pixel may differ from the sky about it, and how many times what that varies there; and the cells about it."""

BELOW = 4 * round(NEAR) + 1
"""Cells from a sky downwards about which it says anything."""


def sky_mask(image: np.ndarray) -> np.ndarray:
    """Pixels `[H, W]` of a uint8 image that are sky whatever else is known: smooth, bright enough, bluish, and joined to the image's top
    row."""
    rgb = ndimage.uniform_filter(image.astype(np.float32), (3, 3, 1))
    grey = rgb.mean(-1)
    return closed(reaching_top(even(grey) & (rgb[..., 2] > rgb[..., 0] + 2) & (grey > 90)))


def even(grey: np.ndarray) -> np.ndarray:
    """Where levels `[H, W]` change as little as a sky's."""
    return np.hypot(ndimage.sobel(grey, 0), ndimage.sobel(grey, 1)) / 8 < EVEN


def reaching_top(mask: np.ndarray) -> np.ndarray:
    """What of a mask is joined to its top rows, in parts that are large enough."""
    label, _ = ndimage.label(mask)
    large = np.bincount(label.ravel()) > 1e-3 * mask.size
    top = np.array([k for k in np.unique(label[:3][mask[:3]]) if large[k]], dtype=label.dtype)
    return np.isin(label, top)


def closed(mask: np.ndarray) -> np.ndarray:
    """A mask without its narrow gaps."""
    # beyond the edge nothing closes, so the edge is repeated
    return ndimage.binary_closing(np.pad(mask, 4, mode="edge"), iterations=2)[4:-4, 4:-4]


def fine_sky(image: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    """Pixels `[H, W]` of a uint8 image that are surely sky where a coarse mask `[h, w]` says so: they look like what of it is about them,
    and do not change as at an edge where the mask ends."""
    found = np.zeros(image.shape[:2], bool)
    rows, columns = (np.arange(n) * of // n for n, of in zip(image.shape[:2], coarse.shape, strict=True))
    step = image.shape[1] // coarse.shape[1]
    # all of it is at the top, where a picture is looked at no farther down than has a say
    end = int(np.flatnonzero(coarse.any(1)).max(initial=-BELOW)) + BELOW
    rows, coarse = rows[rows < end], coarse[:end]
    image = image[: len(rows)]
    if not len(rows):
        return found
    rgb = ndimage.uniform_filter(image.astype(np.float32), (3, 3, 1))
    small = rgb[step // 2 :: step, step // 2 :: step][: coarse.shape[0], : coarse.shape[1]]
    weight = ndimage.gaussian_filter(coarse.astype(np.float32), NEAR) + 1e-6
    mean, squares = (ndimage.gaussian_filter(v * coarse[..., None], (NEAR, NEAR, 0)) / weight[..., None] for v in (small, small**2))
    varies = np.sqrt(np.maximum(squares - mean**2, 0))
    grey = rgb.mean(-1)
    # as the sky itself varies more where wires cross it, they are also told by being darker than both their sides
    dips = ndimage.grey_closing(grey, max(3, image.shape[1] // WIRE)) - grey

    def over(cells: np.ndarray) -> np.ndarray:
        return cells[rows[:, None], columns]

    alike = (np.abs(rgb - over(mean)) < over(RATHER + SPREAD * varies)).all(-1) & (dips < over(RATHER + varies.mean(-1)))
    alike &= over(ndimage.binary_dilation(coarse, iterations=2))
    found[: len(rows)] = alike & (even(grey) | over(ndimage.binary_erosion(coarse, border_value=1)))
    return found


def like_sky(image: np.ndarray, sky: np.ndarray, reach: int = 40) -> np.ndarray:
    """The sky and what looks like the nearest of it, up to `reach` pixels away: gaps between leaves and wires, where splats of its colour
    would float."""
    if not sky.any():
        return sky
    end = int(np.flatnonzero(sky.any(1)).max()) + reach + 1  # no row below has any
    rgb = ndimage.uniform_filter(image[:end].astype(np.float32), (3, 3, 1))
    away, nearest = ndimage.distance_transform_edt(~sky[:end], return_indices=True)
    found = sky.copy()
    found[:end] |= (np.abs(rgb - rgb[tuple(nearest)]).max(-1) < 14) & (away < reach)
    return found


class SkyPicture:
    """Running sums of sky colours by direction, in the reference exposure, on an equirectangular grid `[H, 2H]`; `otherwise` `[3]` is that
    of a sky of which nothing is seen."""

    def __init__(self, height: int, otherwise: np.ndarray):
        self.otherwise = otherwise
        self.sum = np.zeros((height, 2 * height, 3))
        self.count = np.zeros((height, 2 * height))

    def add(self, image: np.ndarray, mask: np.ndarray, camera: Camera, gain: np.ndarray, weight: float = 1.0) -> None:
        """Count the masked pixels of an image `[H, W, 3]` in 0..1, divided by its camera's gain."""
        row, column = (places[mask] for places in _cells(camera, len(self.sum)))
        np.add.at(self.sum, (row, column), weight * image[mask] / gain)
        np.add.at(self.count, (row, column), weight)

    def picture(self) -> torch.Tensor:
        """sRGB float32 `[H, 2H, 3]`: averages where anything was seen, and elsewhere those of all directions that were, the nearer the more
        (inverse distance weighting, Shepard 1968), which leaves no edge; all as `otherwise` without any sample."""
        known = self.count > TRACE
        if not known.any():
            return torch.from_numpy(np.broadcast_to(self.otherwise, self.sum.shape).copy()).float()
        out = torch.from_numpy(self.sum / np.maximum(self.count, TRACE)[..., None]).float()
        towards = texels(*known.shape)[0].float()
        colours, seen, of_seen = self._samples()
        for row in np.flatnonzero(~known.all(1)):
            unseen = torch.from_numpy(~known[row])
            near = (2 - 2 * towards[row, unseen] @ of_seen.T).clamp_min(NEAREST).pow(-FALLS / 2) * seen
            out[row, unseen] = near @ colours / near.sum(1, keepdim=True)
        return out

    def _samples(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Of cells of `COARSE` x `COARSE` directions in which anything was seen: mean colours `[N, 3]`, weights `[N]`, by how much of the
        sphere they cover and less where little was seen, and unit directions `[N, 3]`."""
        side = COARSE if len(self.count) % COARSE == 0 else 1
        count, *sums = (_summed(plane, side) for plane in (self.count, *np.moveaxis(self.sum, -1, 0)))
        there = count > TRACE
        towards, solid = texels(*there.shape)
        colours, count = np.stack(sums, -1)[there] / count[there][:, None], count[there]
        weights = count / (count + np.median(count)) * solid.numpy()[there]
        return torch.from_numpy(colours).float(), torch.from_numpy(weights).float(), towards[torch.from_numpy(there)].float()


def _summed(plane: np.ndarray, side: int) -> np.ndarray:
    """Sums of blocks of `side` x `side`."""
    height, width = plane.shape
    return plane.reshape(height // side, side, width // side, side).sum((1, 3))


def _cells(camera: Camera, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column `[H, W]` of the equirectangular grid `[height, 2 height]` that each pixel looks at."""
    row, column = cells(camera_rays(camera).double() @ camera.world_from_cam[:3, :3].T, height)
    return row.numpy(), column.numpy()


def cells(directions: torch.Tensor, height: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Row and column of an equirectangular grid `[height, 2 height]` that world directions `[..., 3]` of any length point at."""
    x, y, z = directions.unbind(-1)
    column = ((0.5 - torch.atan2(y, x) / (2 * torch.pi)) * 2 * height).long() % (2 * height)
    row = ((0.5 - torch.atan2(z, torch.hypot(x, y)) / torch.pi) * height).long().clamp(0, height - 1)
    return row, column


def always_hidden(looks: Iterable[tuple[np.ndarray, Camera]]) -> torch.Tensor:
    """bool `[HIDDEN, 2 HIDDEN]`: directions that some looks show and none shows the sky in, nor right beside; a look is the mask `[h, w]`
    of what may be sky, and a camera of its size.

    Where the sky was never seen, light from it in a view from elsewhere is a hole: between a tree and the house behind it, say.
    """
    looked, open_ = np.zeros((2, HIDDEN, 2 * HIDDEN), bool)
    for sky, camera in looks:
        row, column = _cells(camera, HIDDEN)
        looked[row, column] = True
        open_[row[sky], column[sky]] = True
    looked, open_ = (np.pad(mask, ((0, 0), (2, 2)), mode="wrap") for mask in (looked, open_))
    looked = ndimage.binary_closing(looked, np.ones((3, 3))) | looked  # a small picture's pixels lie farther apart than directions
    return torch.from_numpy((looked & ~ndimage.binary_dilation(open_, np.ones((3, 3))))[:, 2:-2])


def finer(hidden: torch.Tensor, height: int) -> torch.Tensor:
    """`always_hidden` directions on an equirectangular grid of `height` rows: bool `[height, 2 height]`."""
    return F.interpolate(hidden[None, None].float(), (height, 2 * height))[0, 0] > 0


def seen_sky(scene: Scene, hidden: torch.Tensor) -> Sky:
    """The scene's sky as its cameras saw it, spread into directions in which something always stood before it, as photos say (`hidden`,
    of `always_hidden`) or the splats do.

    What shines through a wall of alpha 0.99 is enough for Adam to turn the texels behind into noise, which a shifted view then shows
    between the houses.
    """
    assert scene.sky is not None
    own = srgb_from_linear(scene.sky.linear).numpy()
    looks, free = np.zeros(own.shape[:2]), np.zeros(own.shape[:2])
    for sky, camera in looks_of(scene):
        place = _cells(camera, len(own))
        np.add.at(looks, place, 1)
        np.add.at(free, place, sky)
    picture = SkyPicture(len(own), np.median(own, axis=(0, 1)))  # where nothing shows it, the fit has left it as it began
    picture.count = np.where((free > FREE * looks) & ~finer(hidden, len(own)).cpu().numpy(), free, 0)
    picture.sum = own * picture.count[..., None]
    return Sky(linear_from_srgb(picture.picture().clamp_min(0)))


@torch.no_grad()
def looks_of(scene: Scene) -> Iterator[tuple[np.ndarray, Camera]]:
    """Masks `[h, w]` of where light comes from the sky, at `LOOKS` moments of each of a scene's cameras, and the cameras of their size."""
    for name in scene.rig:
        times = scene.frame_times(name)
        for k in spread(range(len(times)), LOOKS):
            camera = scene.camera(name, int(times[k]))
            camera = camera.resized(max(16, camera.width // 2), max(16, camera.height // 2))
            alpha = render_frame(scene, camera, ("alpha",)).alpha
            assert alpha is not None
            yield (alpha < 0.5).cpu().numpy(), camera
