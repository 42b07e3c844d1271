"""Does a long rollout drift? Frames are enhanced forwards and backwards until 500 are done, each with what the last ones left."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional as F

from enhance.metrics import sharpness
from enhance.step import Steps
from render.frame_types import Frame
from render.video import read_video

FRAMES = 500
PART = 50
"""Frames that are compared: the first, and the same pictures when they come for the last time."""

KEPT = 60
"""Frames that are held in memory."""

WIDTH = 640


@dataclass(frozen=True)
class Drift:
    """By how much the output against its input changed from the first frames to the last, in percent: mean brightness, the most of the
    three channels' shares of it, and Laplacian variance."""

    brightness: float
    colour: float
    sharpness: float


def drift(enhancer: Steps, pictures: Sequence[Frame | torch.Tensor], frames: int = FRAMES) -> Drift:
    """Of a rollout over `frames` frames: as `of_video` has them, or told their objects. ValueError where there are fewer than two."""
    if len(pictures) < 2:
        raise ValueError(f"a rollout needs at least two frames, got {len(pictures)}; give a longer video")
    part = min(PART, frames // 2)
    pictures = pictures[: (frames - part) // 2 + 1]  # there and back again, or no two frames that are compared would show the same
    found, memory = [], None
    for frame in _back_and_forth(pictures, frames):
        rgb = frame.rgb if isinstance(frame, Frame) else frame
        assert rgb is not None
        everywhere = torch.ones(rgb.shape[:2], dtype=torch.bool)
        better, memory = enhancer.step(frame, memory)
        better = better.cpu()
        before, after = rgb.mean((0, 1)), better.mean((0, 1))
        colour = (after / after.mean()) / (before / before.mean())
        sharp = sharpness(better, everywhere) / max(sharpness(rgb, everywhere), 1e-9)
        found.append([float(after.mean() / before.mean()), *colour.tolist(), sharp])
    period = 2 * len(pictures) - 2
    again = period * ((frames - part) // period)  # the last time that the same pictures came
    first, last = np.mean(found[:part], 0), np.mean(found[again : again + part], 0)
    change = 100 * np.abs(last / first - 1)
    return Drift(float(change[0]), float(change[1:4].max()), float(change[4]))


def of_video(video: str | Path) -> list[torch.Tensor]:
    """Its first frames, as plain RGB."""
    return [_shrunk(rgb) for rgb, _ in zip(read_video(video), range(KEPT), strict=False)]


def _back_and_forth(pictures: Sequence[Frame | torch.Tensor], frames: int) -> Iterator[Frame | torch.Tensor]:
    n = len(pictures)
    for i in range(frames):
        j = i % (2 * n - 2)
        yield pictures[j if j < n else 2 * n - 2 - j]


def _shrunk(rgb: torch.Tensor) -> torch.Tensor:
    h, w = rgb.shape[:2]
    if w <= WIDTH:
        return rgb
    return F.interpolate(rgb.permute(2, 0, 1)[None], (round(h * WIDTH / w), WIDTH), mode="area")[0].permute(1, 2, 0).contiguous()


def drift_text(what: str, d: Drift) -> str:
    return f"drift over {FRAMES} frames of {what}: brightness {d.brightness:.2f} %, colour {d.colour:.2f} %, sharpness {d.sharpness:.2f} %"
