"""The pictures a fit sees: every chosen camera's frames in the chosen span, at working size, kept as uint8."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy import ndimage

from recon.egomask import at_size, ego_mask
from recon.exposed import balanced, exposed
from recon.log import Log, LogCamera
from recon.skies import SkyKind, sky_mask
from recon.sky_kind import coarse_sky, under_their_sky
from recon.view import View
from scenes.camera import followed


@dataclass(frozen=True)
class Frames:
    """The views of a fit; all cameras at one size. Every `held_out`th frame of each camera takes no part in it.

    From the first on (0, 8, ...), or, where poses come from the pictures, from the middle of the eight (4, 12, ...): what the first one
    shows at its edges, no other one does. `under` is one of `SkyKind`.
    """

    names: list[str]
    width: int
    height: int
    views: list[View]
    under: SkyKind = "blue"

    def training(self) -> list[View]:
        return [v for v in self.views if not v.held_out]

    def held_out(self) -> list[View]:
        return [v for v in self.views if v.held_out]

    def sky_of(self, view: View) -> np.ndarray:
        """What of a view is surely sky, pixel by pixel: bool `[H, W]`."""
        found = sky_mask(view.image.numpy(), self.under)
        if view.ego is not None:
            found &= ~view.ego.numpy()
        if self.under == "blue":
            return found
        rows, columns = (np.arange(n) * of // n for n, of in zip(found.shape, view.sky.shape, strict=True))
        return found & ndimage.binary_dilation(view.sky.numpy(), iterations=2)[rows[:, None], columns]

    def followed(self, time_us: int) -> torch.Tensor | None:
        """The gain `[3]` at a time that the cameras have in the mean, None where none varies."""
        return followed(self._gains, time_us)

    @cached_property
    def _gains(self) -> list[tuple[torch.Tensor, torch.Tensor | None]]:
        """Times and gains of each camera's views."""
        mine = [[v for v in self.views if v.camera == c] for c in range(len(self.names))]
        gains = [[v.gain.cpu() for v in views if v.gain is not None] for views in mine]
        times = [torch.tensor([v.time_us for v in views]) for views in mine]
        return [(t, torch.stack(g) if g else None) for t, g in zip(times, gains, strict=True)]

    def of(self, camera: int, held_out: bool = False) -> list[View]:
        return [v for v in self.views if v.camera == camera and v.held_out == held_out]


def load_frames(
    log: Log,
    names: list[str],
    span_us: tuple[int, int],
    size: tuple[int, int],
    held_out: int,
    report: Callable[[], None] = lambda: None,
    gains: bool = True,
) -> Frames:
    """Read the images of cameras `names` whose times lie in `span_us`, resized to `size` (width, height) by area.

    `report` is called after each. Photos of a log without lidar are brought to one exposure (`balanced`); where lidar tells that a
    camera's exposure follows the light, its views say their `gain`, if `gains` are asked for. Raises ValueError where a camera has no
    frame left to train on, or a file does not decode.
    """
    first = held_out // 2 if log.points is not None else 0
    views = []
    for c, name in enumerate(names):
        camera = log.camera(name)
        chosen = [i for i, t in enumerate(camera.times_us.tolist()) if span_us[0] <= t <= span_us[1]]
        images = {}
        for i in chosen:
            images[i] = torch.from_numpy(camera.image(i, *size).copy())
            report()
        ego = _ego(camera, images, size)
        for i, image in images.items():
            views.append(View(c, i, int(camera.times_us[i]), image, held_out > 0 and i % held_out == first, coarse_sky(image, ego), ego))
        if not any(v.camera == c and not v.held_out for v in views):
            there = f"{len(chosen)} of its {len(camera)} lie there" + (f", held out as one of every {held_out}" if chosen else "")
            raise ValueError(f"camera {name} has no frame to train on in the chosen span: {there}; choose a longer one")
    views, under = under_their_sky(log, names, views)
    if log.points is not None:
        views = balanced(log, names, views)
    elif gains:
        views = exposed(log, names, views)
    return Frames(names, *size, views, under)


def _ego(camera: LogCamera, images: dict[int, torch.Tensor], size: tuple[int, int]) -> torch.Tensor | None:
    """The recording car in a camera's images of `size` (width, height), bool `[H, W]`; None where they show nothing of it. Says so."""
    small = ego_mask(camera, list(images), lambda i: images[i].numpy())
    if small is None:
        return None
    part = f"{camera.name}: the lowest part of its pictures, {small.mean():.1%}, shows the recording car itself and is left out"
    print(part, file=sys.stderr)
    return at_size(small, size[1], size[0])
