"""The pictures a fit sees: every chosen camera's frames in the chosen span, at working size, kept as uint8."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage

from recon.gains import picture_gains
from recon.log import Log
from recon.skies import like_sky, sky_mask
from scenes.poses import inverse

RIM = 6
"""Cells, of about 240 across an image, by which what looks like the sky beside it may reach into its rim."""


@dataclass(frozen=True)
class View:
    """One frame: the camera's place in `Frames.names`, its index in the log, time, uint8 image `[H, W, 3]`; held out or not.

    sky: bool `[h, w]`, a coarse mask of what is surely sky.
    """

    camera: int
    index: int
    time_us: int
    image: torch.Tensor
    held_out: bool
    sky: torch.Tensor


@dataclass(frozen=True)
class Frames:
    """The views of a fit; all cameras at one size. Every `held_out`th frame of each camera takes no part in it.

    From the first on (0, 8, ...), or, where frames are photos taken steps apart, from the middle of the eight (4, 12, ...): what the
    first photo shows at its edges, no other one does.
    """

    names: list[str]
    width: int
    height: int
    views: list[View]

    def training(self) -> list[View]:
        return [v for v in self.views if not v.held_out]

    def held_out(self) -> list[View]:
        return [v for v in self.views if v.held_out]

    def of(self, camera: int, held_out: bool = False) -> list[View]:
        return [v for v in self.views if v.camera == camera and v.held_out == held_out]


def load_frames(
    log: Log,
    names: list[str],
    span_us: tuple[int, int],
    size: tuple[int, int],
    held_out: int,
    report: Callable[[], None] = lambda: None,
) -> Frames:
    """Read the images of cameras `names` whose times lie in `span_us`, resized to `size` (width, height) by area.

    `report` is called after each. Photos of a log without lidar are brought to one exposure (`picture_gains`). Raises ValueError
    where a camera has no frame left to train on, or a file does not decode.
    """
    first = held_out // 2 if log.points is not None else 0
    views = []
    for c, name in enumerate(names):
        camera = log.camera(name)
        chosen = [i for i, t in enumerate(camera.times_us.tolist()) if span_us[0] <= t <= span_us[1]]
        for i in chosen:
            image = torch.from_numpy(camera.image(i, *size).copy())
            views.append(View(c, i, int(camera.times_us[i]), image, held_out > 0 and i % held_out == first, _sky(image)))
            report()
        if not any(v.camera == c and not v.held_out for v in views):
            raise ValueError(f"camera {name} has no frame to train on in the chosen span: {len(chosen)} of its {len(camera)} lie there")
    return Frames(names, *size, views if log.points is None else _balanced(log, names, views))


def _balanced(log: Log, names: list[str], views: list[View]) -> list[View]:
    """The views with their pictures divided by what each was exposed more than the others, by the points that they share."""
    assert log.points is not None
    colours, shown = [], []
    for view in views:
        camera = log.camera(names[view.camera]).camera(view.index, view.image.shape[1], view.image.shape[0])
        points = log.points.seen[names[view.camera]][view.index]
        back = inverse(camera.world_from_cam)
        local = torch.from_numpy(log.points.xyz[points]) @ back[:3, :3].T + back[:3, 3]
        pixels = camera.lens.project(local).floor().long()
        size = torch.tensor([camera.width, camera.height])
        inside = ((pixels >= 0) & (pixels < size)).all(1) & (local[:, 2] > 0)
        column, row = pixels[inside].T
        # a point's own pixel is at an edge as likely as not: what is around it is steadier
        smooth = ndimage.uniform_filter(view.image.numpy().astype(np.float32), (5, 5, 0)) / 255
        colours.append(smooth[row, column])
        shown.append(points[inside.numpy()])
    gains = picture_gains(colours, shown, len(log.points.xyz))
    return [replace(v, image=divided(v.image, torch.from_numpy(g).float())) for v, g in zip(views, gains, strict=True)]


def divided(image: torch.Tensor, gain: torch.Tensor) -> torch.Tensor:
    """A uint8 image with a gain `[3]` taken out."""
    return (image.float() / gain).round().clamp(0, 255).to(torch.uint8)


def _sky(image: torch.Tensor) -> torch.Tensor:
    """The sky of an image on a grid about 240 cells wide: without its rim, but for what of that looks like it, where splats of its colour
    would stand before walls as soon as it is seen from elsewhere."""
    step = max(1, image.shape[1] // 240)
    coarse = np.ascontiguousarray(image[step // 2 :: step, step // 2 :: step].numpy())
    return torch.from_numpy(like_sky(coarse, ndimage.binary_erosion(sky_mask(coarse), border_value=1), RIM))
