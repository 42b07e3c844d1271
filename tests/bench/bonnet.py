"""What it is worth to leave the recording car out of a fit: a drive with a bonnet painted over its pictures, with a mask and without.

    python -m tests.bench.bonnet DRIVE [--camera front_camera] [--steps 700] [--splats 60000] [--size 480 270]

PSNR of held-out frames against the pictures as they were recorded, above the bonnet and where it hides the street. The bonnet is red
lacquer in which the street shines upside down; nobody tells where it is.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage

from recon import FitConfig
from recon.evaluation.report import read_out
from recon.log import Log
from render import render_frame
from render.compare import psnr
from tests.bench.changed_pictures import repainted
from tests.bench.recon import fitted, opened


def bonnet(width: int, height: int) -> np.ndarray:
    """Where it is, bool `[height, width]`."""
    y, x = np.mgrid[:height, :width]
    return y > height * (0.86 + 0.06 * (2 * x / width - 1) ** 2)


def painted(log: Log, name: str) -> Log:
    """The drive, with a bonnet in all pictures of a camera."""
    return repainted(log, "painted", _painted, [name], format="JPEG", quality=93)


def _painted(picture: np.ndarray, index: int) -> np.ndarray:
    picture = picture.copy()
    height, width = picture.shape[:2]
    shine = ndimage.gaussian_filter(np.roll(picture[::-1], -int(0.3 * height), 0).astype(np.float32), (height / 135, height / 135, 0))
    grain = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=(height, width)), height / 180) * 0.05 * height
    lacquer = np.array([70, 30, 35]) + 0.35 * shine + grain[..., None]
    where = bonnet(width, height)
    picture[where] = lacquer.clip(0, 255).astype(np.uint8)[where]
    return picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--camera", default="front_camera")
    parser.add_argument("--steps", type=int, default=700)
    parser.add_argument("--splats", type=int, default=60_000)
    parser.add_argument("--size", type=int, nargs=2, default=(480, 270), metavar=("WIDTH", "HEIGHT"))
    asked = parser.parse_args()
    log, size, name = opened(asked.drive), tuple(asked.size), asked.camera
    config = FitConfig(steps=asked.steps, budget=asked.splats)
    red, hidden = painted(log, name), torch.from_numpy(bonnet(*size))
    blind = replace(red.camera(name), ego_mask=np.zeros((1, 1), bool))
    drives = {
        "as recorded": log,
        "painted, found and left out": red,
        "painted, not looked for": replace(red, cameras={**red.cameras, name: blind}),
    }
    print(f"{'':<30} {'above the bonnet':>17} {'behind it':>10} {'mask':>7}   (dB; part of the picture)")
    for row, drive in drives.items():
        scene, frames, rig, *_ = fitted(drive, config, [name], size)
        times = scene.frame_times(name).tolist()
        figures = []
        for view in frames.of(0, held_out=True):
            camera = scene.camera(name, times[view.index])
            with torch.no_grad():
                rgb = render_frame(read_out(scene, camera, rig[name]), camera).rgb
            truth = torch.from_numpy(log.camera(name).image(view.index, *size).copy()).float() / 255
            figures.append((psnr(rgb, truth, ~hidden), psnr(rgb, truth, hidden)))
        above, behind = np.mean(figures, 0)
        ego = frames.views[0].ego
        print(f"{row:<30} {above:>17.2f} {behind:>10.2f} {0.0 if ego is None else float(ego.float().mean()):>7.1%}", flush=True)


if __name__ == "__main__":
    main()
