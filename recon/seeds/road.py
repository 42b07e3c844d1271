"""The road under a drive that has no lidar: of asphalt pictures tell little, but the cameras are carried along it at one height.

It looks like nothing in particular, so that depths on which pictures agree may be decimetres off it, now above and now below, and from
beside the path its lines wind. How high the path is above it, all of these depths and all pictures tell together: pieces of road are laid
out at ever other heights, as two pictures show them, and correlated (a plane sweep, Collins 1996, along the path).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from scipy import ndimage

from recon.ground import above_ground, cells_of
from recon.log import Log, LogCamera
from recon.registration.mounts_by_road import far_pairs, laid_out
from recon.way import LONG, Path
from scenes.ground import Ground
from scenes.trajectory import Trajectory

WAY, PAIRS = 4.0, 24
"""Metres between the pictures of a pair, and how many of a camera, spread over the drive."""

PIXELS = 640
"""Columns at which pictures are laid out, at most: finer grain is noise."""

AHEAD, ROWS, ASIDE = np.arange(3.0, 12.0, 0.5), (0.0, 1.5, 3.0), (-2.5, 0.0, 2.5)
"""Heights of the camera at which the nearest piece may lie before it, and others beyond it, and metres to the left of its view."""

HALF, STEP, SMOOTH = (2.0, 1.25), 0.1, 0.6
"""Metres: half of a piece's length and width, between its points, and over which its brightness is evened out."""

RISES = np.linspace(-0.15, 0.15, 31)
"""Parts of the cameras' height by which the road is tried to be higher than points say that it is in the middle."""

FEWEST, ALIKE, PEAK = 12, 0.3, 0.05
"""Pieces that are needed; how alike they are in the mean at the right height, at least; and how much more than a tenth of it beside."""

TOLD, EVERY = 200, 4.0
"""Points under the path that are needed to say where the road is, and metres of it over which the middle of them is taken."""

WAVES = 0.03
"""Metres off its middle up to which the road is taken to be where points show it."""

WIDE, WIDEST = 4.0, 12.0
"""Metres beside the path up to which the road is known; beyond its ends that is as far as it goes straight on. It may be wider, up to the
other, as far as next to nothing stands on it."""

STANDS, TALL, TELLING = 0.05, 3.0, 100
"""Part of the points above a metre of it that may stand there, of those so many metres high at most, and how many it takes to say so."""

DRIVEN, OFF, KERB, NOISE = 1.5, 0.6, 0.2, 2.5
"""Metres beside the path where the car drove: what is no more metres than this off the road, or half of the cameras' height, is the road;
farther aside so many at least, or times how far points are off it in the median."""


@dataclass(frozen=True)
class Road:
    """Its heights, in a ground, and how many metres off them all is the road, `[Y, X]`: 0 where it is not known."""

    ground: Ground
    slack: np.ndarray

    def off(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Metres `[...]` by which points `[..., 3]`, NaN or not, are above it, and its slack there."""
        known, points = np.isfinite(points).all(-1), np.nan_to_num(points)
        return np.where(known, above_ground(points, self.ground), np.nan), np.where(known, self.slack[cells_of(points, self.ground)], 0.0)

    def points(self) -> np.ndarray:
        """Points `[N, 3]` that lie on it, four in each of its cells."""
        row, column = np.nonzero(self.slack)
        middles = np.stack([column, row], 1) * self.ground.cell + np.array(self.ground.origin)
        quarters = self.ground.cell / 4 * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
        xy = (middles[:, None] + quarters).reshape(-1, 2)
        return np.column_stack([xy, self.ground.height(torch.from_numpy(xy)).numpy()])


def road_by_pictures(
    log: Log, names: Sequence[str], ego: Trajectory, span_us: tuple[int, int], points: np.ndarray, guess: Ground
) -> Road | None:
    """The road along a body's path `ego`, which points `[N, 3]` show roughly, and the pictures of the cameras `names` in a span; in the
    cells of a `guess` of the ground. None where points do not tell it, or are not metric."""
    if not log.meta.get("metric", True):
        return None
    path = Path(ego)
    points = points[np.isfinite(path.tree.query(points[:, :2], distance_upper_bound=WIDEST + 1.0)[0])]
    along, left, level = path.beside(points[:, :2])
    eyes = np.concatenate([log.camera(name).world_from_cam[:, :3, 3].numpy() for name in names])
    mount = float(np.median(eyes[:, 2] - path.beside(eyes[:, :2])[2]))
    near = (np.abs(left) < DRIVEN) & (along > LONG) & (along < len(path.places) - LONG) & (level - points[:, 2] + mount > 0)
    under, along = (level - points[:, 2])[near], along[near]
    if len(under) < TOLD or path.length < 2 * WAY:
        return None
    below = _mode(under)
    stretch = (along / EVERY).astype(np.int64)
    middles = np.array([np.median(under[stretch == k]) for k in np.unique(stretch)])
    waves = float(np.median(np.abs(middles - below)))
    off = min(OFF, (below + mount) / 2)  # what is as high as a low camera is not the road
    if not WAVES < waves < off:
        return None  # it goes along with the path as it is, or the path does not go along it: of one who climbs, or flies
    alike = [p for name in names for p in _pieces(log, log.camera(name), span_us, path, below, below + mount)]
    below -= (below + mount) * _rise(alike)
    told = f"{below + mount:.2f} m below the cameras, all along their path, as its pictures show of it on the whole"
    print(f"{log.path}: points show its road in waves of {100 * waves:.0f} cm, so it is taken to be {told}", file=sys.stderr)
    slack = min(off, max(KERB, NOISE * waves))
    return _laid(path, guess, below, off, slack, [_wide(side * left, points[:, 2] - level + below, slack) for side in (1, -1)])


def _wide(aside: np.ndarray, high: np.ndarray, slack: float) -> float:
    """Metres to one side up to which points `[N]`, so far to that side of the path and so far above the road, show that nothing stands."""
    wide = WIDE
    while wide < WIDEST:
        there = (aside >= wide) & (aside < wide + 1) & (high < TALL)
        if there.sum() < TELLING or (high[there] > slack).mean() > STANDS:
            break
        wide += 1
    return wide


def _rise(alike: Sequence[np.ndarray]) -> float:
    """The part of the cameras' height by which the road is higher, as pieces of it are `alike` `[R]`; 0 where these do not tell."""
    if len(alike) < FEWEST:
        return 0.0
    together = np.mean(alike, 0)
    best = int(together[1:-1].argmax()) + 1
    beside = np.interp([RISES[best] - 0.1, RISES[best] + 0.1], RISES, together)
    if together[best] < ALIKE or together[best] - beside.max() < PEAK:
        return 0.0
    before, at, after = together[best - 1 : best + 2]
    return float(RISES[best] + 0.5 * (before - after) / min(-1e-9, before - 2 * at + after) * (RISES[1] - RISES[0]))


def _mode(values: np.ndarray) -> float:
    """About where most values are: the middle of the shortest stretch that has half of them."""
    ordered = np.sort(values)
    half = len(ordered) // 2
    first = int((ordered[half:] - ordered[: len(ordered) - half]).argmin())
    return float(np.median(ordered[first : first + half + 1]))


def _pieces(log: Log, camera: LogCamera, span_us: tuple[int, int], path: Path, below: float, height: float) -> list[np.ndarray]:
    """How alike a camera's pairs of pictures show pieces of the road before it, `[R]` each, at each of `RISES` of its height from what is
    `below` the path."""

    @lru_cache(16)
    def grey(index: int) -> np.ndarray:
        width = min(PIXELS, camera.width)
        return camera.image(index, width, round(camera.height * width / camera.width)).mean(2).astype(np.uint8)

    x, y = np.meshgrid(*(np.arange(-half, half + STEP / 2, STEP) for half in HALF), indexing="ij")
    middle = x.shape[0] // 2, x.shape[1] // 2
    found = []
    for pair in far_pairs(camera, span_us, PAIRS, WAY):
        eye, view = camera.world_from_cam[pair[1], :2, 3].numpy(), camera.world_from_cam[pair[1], :2, 2].numpy()
        view = view / max(1e-6, float(np.linalg.norm(view)))
        left = np.array([-view[1], view[0]])

        def piece(ahead: float, aside: float, pair=pair, eye=eye, view=view, left=left) -> np.ndarray | None:
            xy = eye + (ahead * height + x)[..., None] * view + (aside + y)[..., None] * left
            _, beside, level = (v.reshape(x.shape) for v in path.beside(xy.reshape(-1, 2)))
            if abs(beside[middle]) > WIDE:
                return None
            return _alike(log, camera, pair, grey, xy, level - below + height * RISES[:, None, None])

        # the nearest that is shown, and no more than some beyond it: farther on the car ahead may hide the road
        nearest = next((ahead for ahead in AHEAD if piece(ahead, 0.0) is not None), None)
        if nearest is not None:
            made = (piece(nearest + row, aside) for row in ROWS for aside in ASIDE)
            found += [p for p in made if p is not None]
    return found


def _alike(
    log: Log, camera: LogCamera, pair: tuple[int, int], grey: Callable[[int], np.ndarray], xy: np.ndarray, levels: np.ndarray
) -> np.ndarray | None:
    """Correlations `[R]` of what two pictures show at places `[X, Y, 2]`, at each of the levels `[R, X, Y]`; None where they do not show
    all of them."""
    spots = np.concatenate([np.broadcast_to(xy, (*levels.shape, 2)), levels[..., None]], -1)
    shown = []
    for index in pair:
        image = laid_out(log, camera, index, grey, spots.reshape(-1, *spots.shape[2:]))
        if image is None:
            return None
        image = image.reshape(levels.shape)
        shown.append(image - ndimage.gaussian_filter(image, (0, SMOOTH / STEP, SMOOTH / STEP)))
    one, other = shown
    return (one * other).sum((1, 2)) / np.maximum(1e-6, np.linalg.norm(one, axis=(1, 2)) * np.linalg.norm(other, axis=(1, 2)))


def _laid(path: Path, guess: Ground, below: float, driven: float, beside: float, wide: Sequence[float]) -> Road:
    """The road so many metres below a path, in a ground's cells; its slack where the car drove, and beside; how wide it is to the left and
    to the right."""
    rows, columns = guess.heights.shape
    x, y = (origin + guess.cell * np.arange(n) for origin, n in zip(guess.origin, (columns, rows), strict=True))
    xy = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    far, _ = path.tree.query(xy, distance_upper_bound=max(wide) + 4 * guess.cell)
    cells = np.flatnonzero(np.isfinite(far))
    along, left, level = path.beside(xy[cells])
    heights, slack = guess.heights.numpy().astype(np.float64).ravel(), np.zeros(rows * columns)
    heights[cells] = level - below  # also of the cells around those that are known, between which heights are linear
    within = (left < wide[0]) & (left > -wide[1]) & (along > 1) & (along < len(path.places) - 2)
    slack[cells[within]] = np.where(np.abs(left[within]) < DRIVEN, driven, beside)
    return Road(replace(guess, heights=torch.from_numpy(heights.reshape(rows, columns)).float()), slack.reshape(rows, columns))
