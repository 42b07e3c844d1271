"""How near a reconstruction comes to the truth beside the path: of places that are made up, and so can be seen from anywhere.

    python -m tests.bench.truth PLACE FOLDER [--meshes ../shared/data/meshes] [--without lidar boxes] [--steps 1000]
        [--splats 80000] [--camera front | left | rolling | fisheye] [--sensor noisy | night] [--look OUT]

FOLDER keeps what was traced of each place, for the next run; rooms have the first two cameras, and each "town 0" to "town 19", a street by
lot, the first. Of frames that no fit saw, at the recorded place and beside it: PSNR of all, of all with the fit's photos (as `render
--enhance` makes each frame by itself), of the ground, and of what moves; how sharp both are, in parts of the truth's variance of the
Laplacian; median relative error of depth; pixels drawn at less than 0.8 ("in the way") and at more than 1.25 times ("beyond") their true
depth, or as sky ("open"), of those that are no sky in truth. --look writes pictures there: what was rendered, that enhanced, and the truth.
With a sensor the drive's pictures have noise, and the truth none.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from PIL import Image

from enhance.enhancer import Enhancer
from enhance.metrics import sharpness
from recon.album import keep_album
from recon.defaults import HELD_OUT, fit_config
from recon.log import Log
from recon.ready import fitted as without_held_out
from render import render_frame
from render.album import shots_in
from render.compare import psnr
from render.rays import world_directions
from render.references import READS, References
from scenes.camera import Camera
from scenes.scene import Scene
from tests.bench.recon import fitted
from tests.bench.references import pictures
from tests.bench.worlds.corner import corner
from tests.bench.worlds.highway import highway
from tests.bench.worlds.lights import lights
from tests.bench.worlds.place import UNSEEN, Level, Place
from tests.bench.worlds.record import Truth, looks, recorded
from tests.bench.worlds.room import room
from tests.bench.worlds.sensor import SENSORS, lit, taken
from tests.bench.worlds.street import street
from tests.bench.worlds.town import town
from tests.bench.worlds.underpass import underpass

TOWNS = 20
"""Streets by lot."""

PLACES: dict[str, Callable[[Path], Place]] = {
    "street": street,
    "corner": corner,
    "highway": highway,
    "lights": lights,
    "underpass": underpass,
    **{f"town {seed}": partial(town, seed=seed) for seed in range(TOWNS)},
    "room": lambda _: room(False),
    "room with people": lambda _: room(True),
}
DECIBELS = ("dB", "enhanced", "ground", "movers")
RATIOS = ("sharp", "enhanced")
SHARES = ("depth off", "in the way", "beyond", "open")
OPEN = 0.5
"""Alpha under which a pixel counts as sky."""

LOW = 0.2
"""Metres above the floor up to which something is the ground: road, kerb and pavement."""


def without(log: Log, what: list[str]) -> Log:
    """The log without its lidar or its boxes: movers are then looked for."""
    return replace(log, sweeps=() if "lidar" in what else log.sweeps, tracks=() if "boxes" in what else log.tracks)


def figures(
    scene: Scene, references: References, enhancer: Enhancer, camera: Camera, truth: Truth, level: Level
) -> tuple[list[float], list[torch.Tensor]]:
    """A row of `DECIBELS`, `RATIOS` and `SHARES` in one, and what is rendered, and that enhanced, `[H, W, 3]`. level: as of `Place`."""
    with torch.no_grad():
        frame = render_frame(scene, camera, READS)
        shown = pictures(references, enhancer, frame)
    assert frame.alpha is not None and frame.depth is not None
    rgb, enhanced = shown["rendered"], shown["enhanced"]
    solid, moving = truth.who >= 0, truth.who > 0
    drawn = (frame.depth / truth.depth)[solid]
    shares = [float(((drawn - 1).abs()).median()), *(float(part.float().mean()) for part in (drawn < 0.8, drawn > 1.25))]
    open_ = float((frame.alpha[solid] < OPEN).float().mean())
    points = camera.world_from_cam[:3, 3] + world_directions(camera) * truth.depth[..., None]
    ground = (truth.who == 0) & (points[..., 2] - level(points[..., 0], points[..., 1]) < LOW)
    parts = [psnr(rgb, truth.rgb, part) if part.any() else float("nan") for part in (ground, moving)]
    lit = truth.who != UNSEEN
    ratios = [sharpness(picture, lit) / sharpness(truth.rgb, lit) for picture in (rgb, enhanced)]
    all_ = [psnr(picture, truth.rgb, lit) for picture in (rgb, enhanced)]
    return [*all_, *parts, *ratios, *(100 * s for s in (*shares, open_))], [rgb, enhanced]


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.truth", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("place", choices=tuple(PLACES))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--meshes", type=Path, default=Path("../shared/data/meshes"))
    parser.add_argument("--without", nargs="+", default=[], choices=("lidar", "boxes"))
    parser.add_argument("--camera", default="front")
    parser.add_argument("--sensor", choices=tuple(SENSORS))
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--splats", type=int, default=80_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--look", type=Path)
    asked = parser.parse_args()
    place = PLACES[asked.place](asked.meshes)
    folder = asked.folder / asked.place.replace(" ", "_")
    sensor, log = SENSORS.get(asked.sensor), recorded(place, [asked.camera], folder)
    log = log if sensor is None else taken(log, sensor, folder / asked.sensor)
    log = without(without_held_out(log, HELD_OUT), asked.without)
    camera, began = place.rig[asked.camera], time.time()
    config = replace(fit_config(log, [asked.camera]), steps=asked.steps, budget=asked.splats, seed=asked.seed)
    scene, frames, rig, *_ = fitted(log, config, [asked.camera], (camera.width, camera.height))
    print(f"fitted in {time.time() - began:.0f} s, {len(scene.background.gaussians)} splats, {len(scene.actors)} movers")
    held_out = [v.index for v in frames.of(0, held_out=True)]
    rows: dict[tuple[float, float], list[list[float]]] = {}
    with TemporaryDirectory() as album:
        keep_album(scene, frames, rig, Path(album))
        enhancer = Enhancer.load()
        assert isinstance(enhancer, Enhancer)
        references = References(shots_in(Path(album), scene), scene)
        for aside, index, truth in looks(place, asked.camera, folder, held_out):
            path = scene.ego.shifted(lateral=aside[0], vertical=aside[1])
            truth = truth if sensor is None else lit(truth, sensor)
            view = scene.camera(asked.camera, int(scene.frame_times(asked.camera)[index]), path)
            row, shown = figures(scene, references, enhancer, view, truth, place.level)
            rows.setdefault(aside, []).append(row)
            if asked.look:
                asked.look.mkdir(parents=True, exist_ok=True)
                stack = (torch.cat([*shown, truth.rgb], 0) * 255).round().to(torch.uint8).numpy()
                Image.fromarray(stack).save(asked.look / f"{asked.camera}_{aside[0]:+g}_{aside[1]:+g}_{index:03d}.png")
    print(f"| m to the left, up | {' | '.join((*DECIBELS, *RATIOS, *SHARES))} |\n|---|{'---|' * len((*DECIBELS, *RATIOS, *SHARES))}")
    forms = ["{:.2f}"] * len(DECIBELS + RATIOS) + ["{:.2f} %"] * len(SHARES)
    for (left, up), found in rows.items():
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # where nobody moves there is no mean of movers
            mean = np.nanmean(np.array(found), 0)
        print(f"| {left:+g}, {up:+g} | {' | '.join(form.format(v) for form, v in zip(forms, mean, strict=True))} |")


if __name__ == "__main__":
    main()
