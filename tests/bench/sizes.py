"""What a scene shows in pictures of other sizes than it was fitted to, against the drive's photos.

    python -m tests.bench.sizes SCENE DRIVE [--camera front_camera] [--every 8]

PSNR in dB, the mean over every `--every`th frame (the fit has seen most of them): by splats that are widened by as many pixels at every
size ("as many pixels"), as they are drawn ("as drawn", `SplatModel.at_scale`), and by the picture of the fitted size, shrunk by its
pixels' means or enlarged bicubically ("resized"), which costs a whole picture; and what the first two take, milliseconds a picture.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from enhance.pairs.clips import scene_time
from recon import open_log
from recon.album import at_once
from render import render_frame
from render.compare import psnr
from render.video import from_bytes
from scenes import Scene, load
from scenes.camera import Camera

SCALES = 1 / 4, 1 / 3, 1 / 2, 2 / 3, 1, 2
"""Of the fitted size."""


def resized(picture: torch.Tensor, width: int, height: int) -> torch.Tensor:
    """A picture `[H, W, 3]` at another size: means of what its pixels cover, bicubic where it grows."""
    planes = picture.permute(2, 0, 1)[None]
    if width > picture.shape[1]:
        planes = F.interpolate(planes, (height, width), mode="bicubic", align_corners=False).clamp(0, 1)
    else:
        planes = F.interpolate(planes, (height, width), mode="area")
    return planes[0].permute(1, 2, 0)


def drawn(scene: Scene, camera: Camera) -> tuple[torch.Tensor, float]:
    """What a camera sees, and how many milliseconds that took."""
    began = time.perf_counter()
    rgb = render_frame(scene, camera).rgb
    assert rgb is not None
    return rgb.clamp(0, 1), 1000 * (time.perf_counter() - began)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.sizes", description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--camera", default="front_camera")
    parser.add_argument("--every", type=int, default=8)
    options = parser.parse_args()
    scene = load(options.scene)
    assert isinstance(scene, Scene)
    unaware = replace(scene, rig={name: replace(c, fitted=False) for name, c in scene.rig.items()})
    recorded = open_log(options.drive).camera(options.camera)
    print("| size | as many pixels | as drawn | resized | ms, as many pixels | ms, as drawn |\n|---|---|---|---|---|---|")
    with torch.no_grad():
        for scale in SCALES:
            found, times, size = [], [], (0, 0)
            for i in range(options.every // 2, len(recorded), options.every):
                whole = scene.camera(options.camera, scene_time(scene, options.camera, int(recorded.times_us[i])))
                size = round(whole.width * scale), round(whole.height * scale)
                if size[0] > recorded.width:
                    break
                camera = whole.resized(*size)
                photo = at_once(scene, camera, recorded, from_bytes(recorded.image(i, *size)))
                pictures = [drawn(unaware, camera), drawn(scene, camera)]
                shown = [*(rgb for rgb, _ in pictures), resized(drawn(scene, whole)[0], *size)]
                found.append([psnr(rgb, photo) for rgb in shown])
                times.append([ms for _, ms in pictures])
            if found:
                cells = [f"{x:.2f}" for x in np.mean(found, 0)] + [f"{x:.0f}" for x in np.median(times, 0)]
                print(f"| {size[0]}x{size[1]} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
