"""What a scene's kept photos are worth to frames that neither the fit nor the references have seen.

    python -m tests.bench.references SCENE DRIVE [--size 640 360] [--every 1]

Every held-out frame of the scene's cameras, at its recorded place, as `render --enhance` makes it alone, against its photo (as a global
shutter would have taken it, which the scene's cameras are): as rendered, with what the photos around show, and enhanced. Sharpness is the
variance of the Laplacian, over the photo's.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

from enhance.clip import enhance_frames
from enhance.enhancer import Enhancer
from enhance.metrics import sharpness
from recon import open_log
from recon.album import at_once
from render import render_frame
from render.album import references_of
from render.compare import psnr, ssim
from render.frame_types import Frame
from render.references import READS, References
from scenes import Scene, load

MEASURES = ("PSNR", "SSIM", "sharpness")
Row = dict[str, tuple[float, ...]]


def pictures(references: References, enhancer: Enhancer, frame: Frame) -> dict[str, torch.Tensor]:
    """By name, `[H, W, 3]`: the frame as rendered, with references, and enhanced."""
    assert frame.rgb is not None
    (given,) = references.along([frame], [frame.camera])
    assert given.reference is not None and given.trust is not None
    rendered = frame.rgb.clamp(0, 1)
    referred = torch.lerp(rendered, given.reference, given.trust[..., None])
    (enhanced,) = enhance_frames([replace(given, flow_prev=None)], enhancer, references.shown)
    assert enhanced.rgb is not None
    return {"rendered": rendered, "+ references": referred, "enhanced": enhanced.rgb}


def measured(scene: Scene, references: References, drive: Path, size: tuple[int, int], every: int) -> Iterator[tuple[str, Row]]:
    """Camera, and by picture what is measured, of one held-out frame after the other."""
    log, enhancer = open_log(drive), Enhancer.load()
    assert isinstance(enhancer, Enhancer)
    kept = {shot.camera.time_us for shot in references.shots}
    for name in scene.rig:
        held_out = [t for t in scene.frame_times(name).tolist() if t not in kept]
        rig = log.rig({name: size})[name]
        for time_us in held_out[::every]:
            camera = scene.rig_camera(name).resized(*size).along(scene.ego, time_us)
            index = int((log.cameras[name].times_us - time_us).abs().argmin())
            photo = torch.from_numpy(log.cameras[name].image(index, *size).copy()).float() / 255
            photo, everywhere = at_once(scene, camera, rig, photo), torch.ones(photo.shape[:2], dtype=torch.bool)
            frame, row = render_frame(scene, camera, READS), {}
            for what, picture in pictures(references, enhancer, frame).items():
                ratio = sharpness(picture, everywhere) / sharpness(photo, everywhere)
                row[what] = (psnr(picture, photo), ssim(picture, photo), ratio)
            yield name, row


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.references", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 360))
    parser.add_argument("--every", type=int, default=1, help="of the held-out frames")
    asked = parser.parse_args()
    scene = load(asked.scene)
    assert isinstance(scene, Scene)
    references = references_of(asked.scene, scene)
    if references is None:
        parser.error(f"{asked.scene} keeps no photos; sidestep recon keeps them")
    found: dict[str, list[Row]] = {}
    with torch.no_grad():
        for name, row in measured(scene, references, asked.drive, (asked.size[0], asked.size[1]), asked.every):
            found.setdefault(name, []).append(row)
    print(f"| camera | frames | picture | {' | '.join(MEASURES)} |\n|---|---|---|---|---|---|")
    for name, rows in found.items():
        for what in rows[0]:
            means = torch.tensor([row[what] for row in rows]).mean(0).tolist()
            print(f"| {name} | {len(rows)} | {what} | {means[0]:.2f} | {means[1]:.3f} | {means[2]:.2f} |")


if __name__ == "__main__":
    main()
