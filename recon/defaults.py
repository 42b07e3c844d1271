"""What a reconstruction takes where nobody says otherwise: cameras, the part of the drive, the pictures' size, steps and splats."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from recon.fit.config import FitConfig
from recon.log import Log

PIXELS = 960 * 540
"""Of the first camera's pictures, at most."""

HELD_OUT = 8
"""Every how many frames, and lidar sweeps, one is held out."""

SHARED, PER_PICTURE = (1_600, 170_000), (8, 700)
"""Steps and largest number of splats of a fit: a base, and so many more a picture. The 240 pictures of three cameras of drive 002 get 3,520
steps and 338,000 splats, the 400 of five 4,800 and 450,000. With two fifths fewer splats the front camera among five loses 0.7 dB, nearly
as much in the fitted pictures as in those held out."""

MOST = 6500, 650_000
"""Steps and splats of any drive at most, unless more effort is asked for: a third more than five cameras of drive 002 get, whose fit takes
twenty minutes."""

FEW, PER_PHOTO = (500, 30_000), (25, 2500)
"""Base and increment as `SHARED` and `PER_PICTURE`, for photos that were taken steps apart (`APART`), few of which show the same. Without
the base, 24 photos of a street lose 0.2 dB at 416x312 and 0.3 at 831x624."""

APART = 0.12
"""Distance between consecutive photos, as a part of the distance to what they show, from which on they count as steps apart. A video's
pictures are closer (0.05 at 12 m/s), and are fitted as a drive's."""

DROP = 0.2
"""Part of the splats that a step leaves out by lot where photos were taken steps apart."""


def choose(
    log: Log, cameras: Sequence[str] | None = None, start_us: int = 0, duration_us: int | None = None
) -> tuple[list[str], tuple[int, int]]:
    """The cameras to fit, the front ones where None, and the first and last microsecond. ValueError for a camera or a part of the drive
    that the log does not have."""
    names = list(dict.fromkeys(cameras or log.front or list(log.cameras)[:1]))
    return names, _span(log, names, start_us, duration_us)


def _span(log: Log, names: list[str], start_us: int, duration_us: int | None) -> tuple[int, int]:
    """First and last microsecond of the part of the drive that begins `start_us` after the first camera's first frame, or a video's, which
    may not have been placed."""
    times = log.camera(names[0]).times_us
    for name in names:
        log.camera(name)
    begun = int(log.meta.get("begun_us", times[0]))
    length = int(times[-1]) - begun
    if not 0 <= start_us <= length:
        raise ValueError(f"start {start_us / 1e6:g}s is outside the drive, which lasts {length / 1e6:g}s")
    if duration_us is not None and duration_us <= 0:
        raise ValueError(f"duration {duration_us / 1e6:g}s must be positive; the drive lasts {length / 1e6:g}s")
    # the cameras of a rig fire up to a tenth of a second apart: half a step around keeps whole frames together
    slack = int(times.diff().double().median()) // 2 if len(times) > 1 else 0
    first = begun + start_us
    last = int(times[-1]) if duration_us is None else min(int(times[-1]), first + duration_us - 2 * slack)
    return first - slack, max(last, first) + slack


def fit_size(log: Log, names: Sequence[str]) -> tuple[int, int]:
    """Width and height to fit at: the first camera's own, shrunk to `PIXELS` where it has more."""
    camera = log.camera(names[0])
    shrink = min(1.0, (PIXELS / (camera.width * camera.height)) ** 0.5)
    return round(camera.width * shrink), round(camera.height * shrink)


def fit_config(log: Log, names: Sequence[str], span: tuple[int, int] | None = None, effort: float = 1.0) -> FitConfig:
    """Steps and splats for the pictures of `span`, all where None: more for more pictures, and `effort` times as many of both.

    Photos that were taken steps apart (`APART`) are overfitted long before a drive's pictures are: view-dependent colours, and many more
    steps and splats than `PER_PHOTO` each, improve the photos and nothing between them. Leaving splats out by lot (`DROP`) does the
    reverse.
    """
    first, last = span or choose(log, names)[1]
    pictures = sum(int(((t >= first) & (t <= last)).sum()) for t in (log.camera(name).times_us for name in names))
    apart = _apart(log, names[0]) > APART
    bases, each = (FEW, PER_PHOTO) if apart else (SHARED, PER_PICTURE)
    steps, splats = (round(effort * min(base + n * pictures, most)) for base, n, most in zip(bases, each, MOST, strict=True))
    return FitConfig(steps=steps, budget=splats, sh_degree=0, drop=DROP) if apart else FitConfig(steps=steps, budget=splats)


def _apart(log: Log, name: str) -> float:
    """Median distance between a camera's consecutive pictures over their median distance to the points that they show; 0 for a log without
    points."""
    if log.points is None:
        return 0.0
    eyes = log.camera(name).world_from_cam[:, :3, 3].numpy()
    shown = [np.linalg.norm(log.points.xyz[points] - eye, axis=1) for points, eye in zip(log.points.seen[name], eyes, strict=True)]
    far = [float(np.median(d)) for d in shown if len(d)]
    steps = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    return float(np.median(steps) / np.median(far)) if len(steps) and far else 0.0
