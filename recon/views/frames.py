"""The pictures a fit sees: every chosen camera's frames in the chosen span, at working size, kept as uint8."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from recon.log import Log, LogCamera
from recon.views.egomask import at_size, not_the_street
from recon.views.exposed import balanced, exposed
from recon.views.skies import WIRE, fine_sky, like_sky
from recon.views.sky_told import coarse_sky, under_their_sky
from recon.views.view import View
from scenes.camera import Camera, followed

SMALLEST = 16
"""Pixels that a picture's sides have at least, shrunk or not: the window of its similarity wants some."""

ALIKE = 0.02
"""Part by which the proportions of two cameras' pictures may differ that are fitted at one size."""


def check_size(size: tuple[int, int]) -> None:
    """ValueError where pictures of a width and height cannot be fitted to."""
    if min(size) < SMALLEST:
        raise ValueError(f"pictures of {size[0]}x{size[1]} are too small to fit to; the smallest size is {SMALLEST}x{SMALLEST}")


@dataclass(frozen=True)
class Frames:
    """The views of a fit, those of camera `names[c]` of width and height `sizes[c]`. Every `held_out`th of each takes no part.

    Those are 8, 16, ..., or, where poses come from the pictures, 4, 12, ..., but neither the first nor the last of a span: what these show
    at their edges, no other one does, and a clip begins and ends with them. Where a long one has none so, the middle one is.
    """

    names: list[str]
    sizes: list[tuple[int, int]]
    views: list[View]

    def camera(self, log: Log, view: View) -> Camera:
        """A view's camera, at the size of its picture and where the log says that it stood."""
        return log.camera(self.names[view.camera]).camera(view.index, *self.sizes[view.camera])

    def training(self) -> list[View]:
        return [v for v in self.views if not v.held_out]

    def held_out(self) -> list[View]:
        return [v for v in self.views if v.held_out]

    def sky_of(self, view: View) -> np.ndarray:
        """What of a view is surely sky, pixel by pixel: bool `[H, W]`."""
        return view.without_ego(fine_sky(view.image.numpy(), view.sky.numpy()))

    def sky_with_rim(self, view: View) -> np.ndarray:
        """The same, and what looks like it as near by as the gaps between wires are: bool `[H, W]`."""
        image = view.image.numpy()
        return view.without_ego(like_sky(image, self.sky_of(view), max(1, image.shape[1] // WIRE)))

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
    """Read the images of cameras `names` whose times lie in `span_us`, resized by area: the first one's to `size` (width, height), the
    others' to `size_like` that.

    `report` is called after each. Photos of a log without lidar are brought to one exposure (`balanced`); where lidar tells that a
    camera's exposure follows the light, its views say their `gain`, if `gains` are asked for. Raises ValueError where a camera has no
    frame in the span, or a file does not decode.
    """
    first = held_out // 2 if log.points is not None else 0
    sizes = [size_like(log.camera(name), log.camera(names[0]), size) for name in names]
    views = []
    for c, name in enumerate(names):
        camera = log.camera(name)
        chosen = [i for i, t in enumerate(camera.times_us.tolist()) if span_us[0] <= t <= span_us[1]]
        if not chosen:
            raise ValueError(f"camera {name} has no frame in the chosen span: none of its {len(camera)} lies there; choose a longer one")
        images = {}
        for i in chosen:
            images[i] = torch.from_numpy(camera.image(i, *sizes[c]).copy())
            report()
        ego = _ego(log, camera, images, sizes[c])
        unseen = _unseen(chosen, held_out, first)
        for i, image in images.items():
            views.append(View(c, i, int(camera.times_us[i]), image, i in unseen, coarse_sky(image, ego), ego))
    views = under_their_sky(log, names, views, log.points)
    if log.points is not None:
        views = balanced(log, names, views)
    elif gains:
        views = exposed(log, names, views)
    return Frames(names, sizes, views)


def _unseen(chosen: list[int], held_out: int, first: int) -> set[int]:
    """Which of a camera's frames, rising indices, take no part (`Frames`): from `first` on every `held_out`th of those between the ends."""
    if held_out <= 0:
        return set()
    middle = {chosen[len(chosen) // 2]} if len(chosen) >= held_out else set()
    return {i for i in chosen[1:-1] if i % held_out == first} or middle


def size_like(camera: LogCamera, first: LogCamera, size: tuple[int, int]) -> tuple[int, int]:
    """Width and height for a camera's pictures where the first one's have `size`: the same, but for a camera of other proportions, which
    has as many pixels in its own, and no more than it recorded. (One of Argoverse 2's looks ahead upright, the others are wide.)"""
    wider = camera.width * first.height / (camera.height * first.width)
    if abs(wider - 1) < ALIKE:
        return size
    width, height = size[0] * wider**0.5, size[1] / wider**0.5
    shrink = min(1.0, camera.width / width, camera.height / height)
    return max(SMALLEST, round(width * shrink)), max(SMALLEST, round(height * shrink))


def _ego(log: Log, camera: LogCamera, images: dict[int, torch.Tensor], size: tuple[int, int]) -> torch.Tensor | None:
    """The recording car in a camera's images of `size` (width, height), what is drawn over them and what lies beyond the lens's image, bool
    `[H, W]`; None where there is nothing of these. Says so."""
    masks = []
    for told, small in not_the_street(log, camera, list(images), lambda i: images[i].numpy()).items():
        print(f"{camera.name}: {told.format(f'{small.mean():.1%}')} and is left out", file=sys.stderr)
        masks.append(at_size(small, size[1], size[0]))
    return torch.stack(masks).any(0) if masks else None
