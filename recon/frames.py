"""The pictures a fit sees: every chosen camera's frames in the chosen span, at working size, kept as uint8."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy import ndimage

from recon.egomask import at_size, ego_mask
from recon.gains import gains_along, picture_gains
from recon.log import Log, LogCamera
from recon.project import project
from recon.skies import WHITE, SkyKind, like_sky, sky_mask
from scenes.camera import Camera, followed
from scenes.poses import inverse
from scenes.trajectory import between

RIM = 6
"""Cells, of about 240 across an image, by which what looks like the sky beside it may reach into its rim."""

BLUE = 0.02
"""Part of a drive's pictures from which on their sky is blue, and no other colour is taken for it, but for clipped white beside it."""

DAZZLED = 1.2
"""How many times as much sky there must be with what is clipped for that to be taken for it."""

SWEEPS = 16
"""Sweeps, spread over the span, by which is told what is no sky."""

VARIES, LOOKED = 0.12, 4
"""Spread of the logarithms of a camera's gains from which on each frame has its own, and every which frame shows whether they vary. Those
of drive 002's right cameras spread by 0.07: that gains nothing there, and a haze makes up for the tints in which other cameras see it."""

PROBED = 3000
"""Points of a sweep by which exposures are compared, of those within reach."""

REACH = 40.0
"""Metres up to which these are taken: little comes between them and a camera a second later."""

STRUCK, AROUND = 0.1, 7
"""Part of what looks like sky in so many columns, as far up as beams go, from which on, where lidar strikes it, it is a wall."""

STRAY = 0.005
"""Part of a sweep's points in a picture that may lie above where its beams go in general."""


@dataclass(frozen=True)
class View:
    """One frame: the camera's place in `Frames.names`, its index in the log, time, uint8 image `[H, W, 3]`; held out or not.

    sky: bool `[h, w]`, a coarse mask of what is surely sky. ego: bool `[H, W]`, where its camera always sees the recording car (one tensor
    for all its views); None where nowhere. gain: float32 `[3]`, how many times as much as its camera's views in the mean it was exposed;
    None where all were alike.
    """

    camera: int
    index: int
    time_us: int
    image: torch.Tensor
    held_out: bool
    sky: torch.Tensor
    ego: torch.Tensor | None = None
    gain: torch.Tensor | None = None

    def to(self, device: torch.device | str) -> View:
        """The same view with its picture on a device."""
        ego, gain = (None if t is None else t.to(device) for t in (self.ego, self.gain))
        return replace(self, image=self.image.to(device), sky=self.sky.to(device), ego=ego, gain=gain)

    def evenly(self, *pixels: np.ndarray) -> np.ndarray:
        """float32 `[H, W, 3]`, or `[N, 3]` at rows and columns: the image as its camera would have taken it, had it exposed all its views
        alike; clipped where it is."""
        image = self.image.numpy()[pixels] / np.float32(255)
        return image if self.gain is None else image / self.gain.numpy()

    def shows_street(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Whether pixels of the image are neither surely sky nor the recording car; bool of the shape of `row` and `column`."""
        step = np.array(self.image.shape[:2]) / self.sky.shape
        street = ~self.sky.numpy()[(row / step[0]).astype(np.int64), (column / step[1]).astype(np.int64)]
        return street if self.ego is None else street & ~self.ego.numpy()[row, column]


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

    `report` is called after each. Photos of a log without lidar are brought to one exposure (`picture_gains`); where lidar tells that a
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
            views.append(View(c, i, int(camera.times_us[i]), image, held_out > 0 and i % held_out == first, _sky(image, ego), ego))
        if not any(v.camera == c and not v.held_out for v in views):
            raise ValueError(f"camera {name} has no frame to train on in the chosen span: {len(chosen)} of its {len(camera)} lie there")
    views, under = _under_their_sky(log, names, views)
    if log.points is not None:
        views = _balanced(log, names, views)
    elif gains:
        views = _exposed(log, names, views)
    return Frames(names, *size, views, under)


def _under_their_sky(log: Log, names: list[str], views: list[View]) -> tuple[list[View], SkyKind]:
    """The views, and which of `SkyKind` theirs is: then each is told its sky as such a one is known.

    One that is not blue takes colour, and what lidar strikes is left out: a white wall fits the description as well. Beside blue, white is
    sky only where there is lidar to tell.
    """
    blue = float(np.mean([v.sky.float().mean() for v in views]))
    within = log.sweeps_within((min(v.time_us for v in views), max(v.time_us for v in views)))
    if (blue >= BLUE and not within) or all(_colourless(v.image) for v in views[:: max(1, len(views) // 8)]):
        return views, "blue"
    chosen = [within[i] for i in np.unique(np.linspace(0, len(within) - 1, min(SWEEPS, len(within))).astype(int))]
    points = [s.read().xyz for s in chosen]
    kind: SkyKind = "blinding" if blue >= BLUE else "overcast"
    more = DAZZLED if blue >= BLUE else 2
    if kind == "blinding" and float(np.mean([(v.image[::4, ::4].amin(-1) >= WHITE).float().mean() for v in views])) < blue * (DAZZLED - 1):
        return views, "blue"
    told = []
    for view in views:
        sky = _sky(view.image, view.ego, kind).numpy()
        if chosen:
            nearest = min(range(len(chosen)), key=lambda i: abs(chosen[i].time_us - view.time_us))
            camera = log.camera(names[view.camera]).camera(view.index, sky.shape[1], sky.shape[0])
            sky = _unstruck(sky, points[nearest], camera)
        told.append(replace(view, sky=torch.from_numpy(sky) | view.sky if kind == "blinding" else torch.from_numpy(sky)))
    if float(np.mean([v.sky.float().mean() for v in told])) <= more * blue:
        return views, "blue"
    return told, kind


def _colourless(image: torch.Tensor) -> bool:
    return bool((image[..., 0] == image[..., 2]).all())


def _unstruck(sky: np.ndarray, points: np.ndarray, camera: Camera) -> np.ndarray:
    """A mask `[h, w]` without the columns in which lidar's `points` `[N, 3]`, as a camera of its size sees them, strike it."""
    row, column, _, inside = project(points, inverse(camera.world_from_cam).numpy(), camera)
    struck = np.zeros(sky.shape, np.float32)
    struck[row[inside], column[inside]] = 1
    # what is above all beams but some stray ones they do not tell
    reached = np.arange(len(sky))[:, None] >= (np.quantile(row[inside], STRAY) if inside.any() else len(sky))
    hits, cells = (ndimage.uniform_filter1d(m.sum(0, dtype=np.float32), AROUND) for m in (struck * sky * reached, sky & reached))
    return sky & (hits <= STRUCK * cells)


def _balanced(log: Log, names: list[str], views: list[View]) -> list[View]:
    """The views with their pictures divided by what each was exposed more than the others, by the points that they share."""
    assert log.points is not None
    colours, shown = [], []
    for view in views:
        camera = log.camera(names[view.camera]).camera(view.index, view.image.shape[1], view.image.shape[0])
        points = log.points.seen[names[view.camera]][view.index]
        row, column, _, inside = project(log.points.xyz[points], inverse(camera.world_from_cam).numpy(), camera)
        # a point's own pixel is at an edge as likely as not: what is around it is steadier
        smooth = ndimage.uniform_filter(view.image.numpy().astype(np.float32), (5, 5, 0)) / 255
        colours.append(smooth[row[inside], column[inside]])
        shown.append(points[inside])
    gains = picture_gains(colours, shown, len(log.points.xyz))
    return [replace(v, image=divided(v.image, torch.from_numpy(g).float())) for v, g in zip(views, gains, strict=True)]


def _exposed(log: Log, names: list[str], views: list[View]) -> list[View]:
    """The views with their gains, where a camera's vary, which it says; those of held-out views are what their neighbours' make likely."""
    sweeps = log.sweeps_within((min(v.time_us for v in views), max(v.time_us for v in views)))
    if not sweeps:
        return views
    known: dict[int, np.ndarray] = {}

    def points(view: View, camera: Camera) -> np.ndarray:
        nearest = min(sweeps, key=lambda s: abs(s.time_us - view.time_us))
        if nearest.index not in known:
            xyz = nearest.read().xyz
            near = xyz[np.linalg.norm(xyz - camera.world_from_cam[:3, 3].numpy(), axis=1) < REACH]
            known[nearest.index] = near[:: max(1, len(near) // PROBED)]
        return known[nearest.index]

    def gains(mine: list[View], name: str) -> np.ndarray:
        cameras = [log.camera(name).camera(v.index) for v in mine]
        return gains_along([v.image for v in mine], cameras, [points(v, c) for v, c in zip(mine, cameras, strict=True)])

    out = []
    for c, name in enumerate(names):
        mine = [v for v in views if v.camera == c]
        shown = [v for v in mine if not v.held_out]
        few = np.log(gains(shown[:: min(LOOKED, 1 + len(shown) // 16)], name))  # NaN where frames so far apart show nothing together
        varies = np.isnan(few).any() or few.std(0).max() >= VARIES
        logs = torch.from_numpy(np.log(gains(shown, name))).float() if varies else torch.zeros(0, 3)
        told = logs.isfinite().all(1)
        if told.sum() < 2 or logs[told].std(0).max() < VARIES:
            out += mine
            continue
        shown, logs = [v for v, t in zip(shown, told.tolist(), strict=True) if t], logs[told]
        least, most = logs.mean(1).exp().aminmax()
        print(f"{name}: its exposure varies, {float(most / least):.1f}-fold; each frame is given its own", file=sys.stderr)
        times = torch.tensor([v.time_us for v in shown])
        out += [replace(v, gain=between(times, logs, v.time_us).exp()) for v in mine]
    return out


def divided(image: torch.Tensor, gain: torch.Tensor) -> torch.Tensor:
    """A uint8 image with a gain `[3]` taken out."""
    return (image.float() / gain).round().clamp(0, 255).to(torch.uint8)


def _ego(camera: LogCamera, images: dict[int, torch.Tensor], size: tuple[int, int]) -> torch.Tensor | None:
    """The recording car in a camera's images of `size` (width, height), bool `[H, W]`; None where they show nothing of it. Says so."""
    small = ego_mask(camera, list(images), lambda i: images[i].numpy())
    if small is None:
        return None
    part = f"{camera.name}: the lowest part of its pictures, {small.mean():.1%}, shows the recording car itself and is left out"
    print(part, file=sys.stderr)
    return at_size(small, size[1], size[0])


def _sky(image: torch.Tensor, ego: torch.Tensor | None, kind: SkyKind = "blue") -> torch.Tensor:
    """The sky of an image on a grid about 240 cells wide: without its rim, but for what of that looks like it, where splats of its colour
    would stand before walls as soon as it is seen from elsewhere. Nothing of it is in the recording car."""
    step = max(1, image.shape[1] // 240)
    coarse = np.ascontiguousarray(image[step // 2 :: step, step // 2 :: step].numpy())
    found = torch.from_numpy(like_sky(coarse, ndimage.binary_erosion(sky_mask(coarse, kind), border_value=1), RIM))
    return found if ego is None else found & ~ego[step // 2 :: step, step // 2 :: step]
