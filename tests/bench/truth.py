"""How near a reconstruction comes to the truth beside the path: of places that are made up, and so can be seen from anywhere.

    python -m tests.bench.truth PLACE FOLDER [--meshes ../shared/data/meshes] [--without lidar boxes] [--camera front] [--steps 1000]
        [--splats 80000] [--look OUT]

FOLDER keeps what was traced of each place, for the next run. Of frames that no fit saw, at the recorded place and beside it: PSNR of all,
of the ground, and of what moves; median relative error of depth; pixels drawn at less than 0.8 ("in the way") and at more than 1.25 times
("beyond") their true depth, or as sky ("open"), of those that are no sky in truth. --look writes pictures there: what was rendered over the
truth.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from recon.defaults import HELD_OUT, fit_config
from recon.log import Log
from recon.ready import fitted as without_held_out
from render import render_frame
from render.compare import psnr
from render.rays import world_directions
from scenes.scene import Scene
from tests.bench.recon import fitted
from tests.bench.worlds.place import Place
from tests.bench.worlds.record import Truth, looks, recorded
from tests.bench.worlds.room import room
from tests.bench.worlds.street import street

PLACES: dict[str, Callable[[Path], Place]] = {"street": street, "room": lambda _: room(False), "room with people": lambda _: room(True)}
HEADS = ("dB", "ground", "movers", "depth off", "in the way", "beyond", "open")
OPEN = 0.5
"""Alpha under which a pixel counts as sky."""

LOW = 0.2
"""Metres above the floor up to which something is the ground: road, kerb and pavement, all of which these places have level."""


def without(log: Log, what: list[str]) -> Log:
    """The log without its lidar or its boxes: movers are then looked for."""
    return replace(log, sweeps=() if "lidar" in what else log.sweeps, tracks=() if "boxes" in what else log.tracks)


def figures(scene: Scene, name: str, index: int, aside: tuple[float, float], truth: Truth) -> tuple[list[float], torch.Tensor]:
    """A row of `HEADS`, and the picture that is rendered `[H, W, 3]`."""
    path = scene.ego.shifted(lateral=aside[0], vertical=aside[1])
    camera = scene.camera(name, int(scene.frame_times(name)[index]), path)
    with torch.no_grad():
        frame = render_frame(scene, camera, ("rgb", "alpha", "depth"))
    assert frame.rgb is not None and frame.alpha is not None and frame.depth is not None
    solid, moving = truth.who >= 0, truth.who > 0
    drawn = (frame.depth / truth.depth)[solid]
    shares = [float(((drawn - 1).abs()).median()), *(float(part.float().mean()) for part in (drawn < 0.8, drawn > 1.25))]
    open_ = float((frame.alpha[solid] < OPEN).float().mean())
    heights = camera.world_from_cam[2, 3] + world_directions(camera)[..., 2] * truth.depth
    ground = (truth.who == 0) & (heights < LOW)
    parts = [psnr(frame.rgb, truth.rgb, part) if part.any() else float("nan") for part in (ground, moving)]
    return [psnr(frame.rgb, truth.rgb), *parts, *(100 * s for s in (*shares, open_))], frame.rgb.clamp(0, 1)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.truth", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("place", choices=tuple(PLACES))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--meshes", type=Path, default=Path("../shared/data/meshes"))
    parser.add_argument("--without", nargs="+", default=[], choices=("lidar", "boxes"))
    parser.add_argument("--camera", default="front")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--splats", type=int, default=80_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--look", type=Path)
    asked = parser.parse_args()
    place = PLACES[asked.place](asked.meshes)
    folder = asked.folder / asked.place.replace(" ", "_")
    log = without(without_held_out(recorded(place, [asked.camera], folder), HELD_OUT), asked.without)
    camera, began = place.rig[asked.camera], time.time()
    config = replace(fit_config(log, [asked.camera]), steps=asked.steps, budget=asked.splats, seed=asked.seed)
    scene, frames, *_ = fitted(log, config, [asked.camera], (camera.width, camera.height))
    print(f"fitted in {time.time() - began:.0f} s, {len(scene.background.gaussians)} splats, {len(scene.actors)} movers")
    held_out = [v.index for v in frames.of(0, held_out=True)]
    rows: dict[tuple[float, float], list[list[float]]] = {}
    for aside, index, truth in looks(place, asked.camera, folder, held_out):
        row, picture = figures(scene, asked.camera, index, aside, truth)
        rows.setdefault(aside, []).append(row)
        if asked.look:
            asked.look.mkdir(parents=True, exist_ok=True)
            both = (torch.cat([picture, truth.rgb], 0) * 255).round().to(torch.uint8).numpy()
            Image.fromarray(both).save(asked.look / f"{asked.camera}_{aside[0]:+g}_{aside[1]:+g}_{index:03d}.png")
    print(f"| m to the left, up | {' | '.join(HEADS)} |\n|---|{'---|' * len(HEADS)}")
    for (left, up), found in rows.items():
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # where nobody moves there is no mean of movers
            mean = np.nanmean(np.array(found), 0)
        print(f"| {left:+g}, {up:+g} | {' | '.join(f'{v:.2f}' for v in mean[:3])} | {' | '.join(f'{v:.2f} %' for v in mean[3:])} |")


if __name__ == "__main__":
    main()
