"""Noisy cameras: a made-up drive's pictures as they would be taken with less light, and what they would be without noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from recon.log import Log
from scenes.atomic import atomic_file
from tests.bench.worlds.record import Truth

GAMMA = 2.2


@dataclass(frozen=True)
class Sensor:
    """A camera that gets so much of the `light`, whose linear values 0..1 have variances `dark` and, times the value, `photons`. quality:
    of the JPEG that it writes, PNG where None."""

    light: float
    dark: float
    photons: float
    quality: int | None


SENSORS = {"noisy": Sensor(1.0, 4e-4, 1.5e-3, 75), "night": Sensor(0.08, 2e-5, 4e-4, None)}
"""Noise of 5 levels of 255 in the bright to 13 in the dark; and a twelfth of the light, with 2 to 7."""


def taken(log: Log, sensor: Sensor, folder: Path) -> Log:
    """The log with pictures that a sensor takes, which the folder keeps."""
    chance, cameras = np.random.default_rng(5), {}
    folder.mkdir(parents=True, exist_ok=True)
    for name, camera in log.cameras.items():
        files = []
        for i in range(len(camera)):
            linear = sensor.light * (camera.image(i) / 255) ** GAMMA
            noise = chance.normal(size=linear.shape) * np.sqrt(sensor.dark + sensor.photons * linear)
            shown = np.clip(linear + noise, 0, 1) ** (1 / GAMMA)
            files.append(folder / f"{name}_{i:03d}.{'jpg' if sensor.quality else 'png'}")
            with atomic_file(files[-1]) as part:
                picture = Image.fromarray((shown * 255).round().astype(np.uint8))
                picture.save(part, "JPEG" if sensor.quality else "PNG", quality=sensor.quality)
        cameras[name] = replace(camera, files=tuple(files))
    return replace(log, cameras=cameras)


def lit(truth: Truth, sensor: Sensor) -> Truth:
    """The truth as a sensor without noise would show it."""
    rgb: torch.Tensor = (sensor.light * truth.rgb**GAMMA) ** (1 / GAMMA)
    return replace(truth, rgb=rgb)
