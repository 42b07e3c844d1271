"""One picture that a fit sees."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch


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

    def without_ego(self, mask: np.ndarray) -> np.ndarray:
        """What of a mask `[H, W]` of the image is not the recording car."""
        return mask if self.ego is None else mask & ~self.ego.numpy()

    def shows_street(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Whether pixels of the image are neither surely sky nor the recording car; bool of the shape of `row` and `column`."""
        step = np.array(self.image.shape[:2]) / self.sky.shape
        street = ~self.sky.numpy()[(row / step[0]).astype(np.int64), (column / step[1]).astype(np.int64)]
        return street if self.ego is None else street & ~self.ego.numpy()[row, column]
