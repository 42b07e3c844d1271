"""Which frames of a video show the world, and what of each: none twice, none blank, and no black bars around them.

Screen recorders and dash cameras repeat frames where no new one was ready: the car would stand still at one moment and go twice as fast at
the next, and repeats would be held out beside their like. Edited clips begin with a black screen; copies for other screens have bars, which
would be fitted as part of the world.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import torch
from torch.nn import functional as F

from render.video import Video, read_video, write_image

RATE, MOST = 10.0, 150
"""Frames a second that are taken from a video, and how many of it at most: more say little more, and matching takes long."""

FAR_APART = 0.5
"""Seconds between frames from which on those of a car may share too little: at 50 km/h it goes seven metres."""

CELL = 8
"""Pixels along the sides of the cells whose mean brightness tells frames apart."""

SAME, BLANK = 3.5 / 255, 8 / 255
"""By how much a repeated frame's cells differ at most, being compressed once more, and those of a frame that shows nothing from each
other."""

BLACK, THIN, UNEVEN = 20 / 255, 0.02, 0.01
"""Brightness that bars have at most; of a picture's side, how wide they are at least, and how much wider one may be than the other."""


@dataclass(frozen=True)
class Taken:
    """Frames of a video that were written: their times in microseconds since its first by name; how many frames the part has that they are
    from; and how many were left out as repeats, or blank."""

    times: dict[str, int]
    count: int
    repeats: int
    blank: int


def take_frames(path: Path, folder: Path, start_us: int = 0, duration_us: int | None = None) -> Taken:
    """Write frames of a part of a video to `folder`, evenly over its time; stderr tells of what is left out, and of frames far apart.
    ValueError where the video does not last as long."""
    video = read_video(path)
    length = video.seconds or max(t for _, t, _ in video.picked(lambda _: True)) / 1e6
    if not 0 <= start_us < length * 1e6:
        raise ValueError(f"start {start_us / 1e6:g}s is outside {path}, which lasts {length:g}s")
    if duration_us is not None and duration_us <= 0:
        raise ValueError(f"duration {duration_us / 1e6:g}s must be positive; {path} lasts {length:g}s")
    end_us = None if duration_us is None else start_us + duration_us
    seconds = (length if end_us is None else min(length, end_us / 1e6)) - start_us / 1e6
    step = max(1 / RATE, seconds / MOST)
    if step > FAR_APART:
        part = f"give --start and a --duration of up to {FAR_APART * MOST:g}s, better {MOST / RATE:g}s, for a part of it"
        print(f"{path}: of {seconds:.0f} s a frame every {step:.1f} s is taken, between which a car goes far; {part}", file=sys.stderr)
    # the next one that is due, or comes at most half a frame too early
    apart = max(1, round((step - 0.5 / video.fps) * 1e6))
    folder.mkdir()
    taken, box = _written(video, folder, start_us, end_us, apart)
    if box is not None:
        taken, _ = _written(video, folder, start_us, end_us, apart, box)
        size = f"{box[1].stop - box[1].start}x{box[0].stop - box[0].start} of {video.width}x{video.height}"
        print(f"{path}: black bars around its pictures are left out, which are {size}", file=sys.stderr)
    if taken.repeats or taken.blank:
        print(f"{path}: frames left out: {taken.repeats} that repeat the one before, {taken.blank} that show nothing", file=sys.stderr)
    return taken


def _written(
    video: Video, folder: Path, start_us: int, end_us: int | None, apart: int, box: tuple[slice, slice] | None = None
) -> tuple[Taken, tuple[slice, slice] | None]:
    """The frames that are due `apart` microseconds after the one before, cut to rows and columns `box` where told, written to `folder`; and
    what is between black bars of them all, None where there are none."""
    times: dict[str, int] = {}
    last, count, repeats, blank = start_us - apart, 0, 0, 0
    before = brightest = None

    def due(time_us: int) -> bool:
        nonlocal count
        count += time_us >= start_us
        return time_us >= start_us and time_us - last >= apart

    for i, time_us, frame in video.picked(due, end_us):
        look = F.avg_pool2d(frame.mean(-1)[None], CELL, ceil_mode=True)[0]
        if look.max() - look.min() < BLANK:
            blank += 1
        elif before is not None and (look - before).abs().max() < SAME:
            repeats += 1
        else:
            shown = frame.amax(-1)
            brightest = shown if brightest is None else torch.maximum(brightest, shown)
            name, before = f"{i:06d}.jpg", look
            write_image(folder / name, _square(frame if box is None else frame[box], float(video.pixel_aspect)))
            times[name] = last = time_us
    return Taken(times, count, repeats, blank), None if brightest is None else _between_bars(brightest)


def _between_bars(brightest: torch.Tensor) -> tuple[slice, slice] | None:
    """Rows and columns of pictures whose pixels are at most as bright as `[H, W]`, without black bars on two opposite sides; None where
    there are none."""
    inside = [slice(0, side) for side in brightest.shape]
    for axis, side in enumerate(brightest.shape):
        lit = (brightest.mean(1 - axis) > BLACK).nonzero()[:, 0]
        if not len(lit):
            return None
        before, after = int(lit[0]), side - 1 - int(lit[-1])
        if min(before, after) >= THIN * side and abs(before - after) <= UNEVEN * side:
            inside[axis] = slice(before + 1, side - after - 1)  # the outermost line of a picture is half a bar
    return None if all(s == slice(0, side) for s, side in zip(inside, brightest.shape, strict=True)) else (inside[0], inside[1])


def _square(frame: torch.Tensor, aspect: float) -> torch.Tensor:
    """A frame `[H, W, 3]` whose pixels are so many times as wide as high, with square ones: a lens has one focal length for both."""
    height, width = round(frame.shape[0] * max(1, 1 / aspect)), round(frame.shape[1] * max(1, aspect))
    if (height, width) == frame.shape[:2]:
        return frame
    return F.interpolate(frame.movedim(2, 0)[None], (height, width), mode="bilinear")[0].movedim(0, 2)
