"""What each part of a fit is worth: held-out PSNR of short fits of one drive with it and without.

    python -m tests.bench.recon DRIVE [--cameras NAME ...] [--steps 1200] [--splats 100000] [--size 480 270] [--only PART ...] [--seed 0]

The first row is the whole fit; every other one leaves one part out and says what that costs, over held-out frames while the car drives.
The same seed draws the same views in all of them; two runs of one row differ by 0.03 dB where only the seed does. "depth" is
the median error of depth on lidar sweeps that no fit saw, in percent, as recorded and 2 m aside of the path. "movers" is all pixels of all
held-out frames in the recorded boxes of what moves, taller than 20 pixels, where the first row's scene without them shows nothing
nearer, "people" the same of who has limbs; "-" where there are none. DRIVE may be "walk": a made-up street with two people who walk
(tests/walker.py), 192x108.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError

from recon import open_log
from recon.assemble import assemble
from recon.begin import begin
from recon.defaults import HELD_OUT, choose, fit_config
from recon.evaluation.offpath import held_out_sweeps, off_path_table
from recon.evaluation.report import held_out_table, read_out
from recon.fit.config import FitConfig
from recon.log import Log, Sweep, Track
from recon.objects.tracks import LIMBED
from recon.ready import annotated, readied
from recon.registration.corrected import as_corrected
from recon.views.frames import Frames
from render import render_frame
from scenes.camera import Camera, RigCamera
from scenes.poses import inverse
from scenes.scene import Scene

TALL = 20.0
"""Pixels from which on movers count."""

Setting = tuple[Log, FitConfig]
PARTS: dict[str, Callable[[Log, FitConfig], Setting]] = {}


def part(leave_out: Callable[[Log, FitConfig], Setting]) -> Callable[[Log, FitConfig], Setting]:
    PARTS[leave_out.__name__.replace("_", " ")] = leave_out
    return leave_out


@part
def rolling_shutter(log: Log, config: FitConfig) -> Setting:
    instant = {name: replace(camera, shutter="global", readout_us=0) for name, camera in log.cameras.items()}
    return replace(log, cameras=instant), config


@part
def splats_left_out_by_lot(log: Log, config: FitConfig) -> Setting:
    """Which none is in a drive."""
    return log, replace(config, drop=0.0)


@part
def measured_depths(log: Log, config: FitConfig) -> Setting:
    return log, replace(config, depth_weight=0.0)


def _unrefined(what: str) -> None:
    def leave_out(log: Log, config: FitConfig) -> Setting:
        return log, config.without(what)

    PARTS[f"refinement of {what}"] = leave_out


for kind in FitConfig().refine:
    _unrefined(kind)


@part
def boxes(log: Log, config: FitConfig) -> Setting:
    """Which are then found in its lidar."""
    return annotated(replace(log, tracks=()), log.sweeps), config


@part
def lidar(log: Log, config: FitConfig) -> Setting:
    return replace(log, sweeps=()), config


@part
def lidar_and_boxes(log: Log, config: FitConfig) -> Setting:
    """What is left is a video with poses."""
    return replace(log, sweeps=(), tracks=()), config


@part
def movers(log: Log, config: FitConfig) -> Setting:
    return replace(log, tracks=()), config


Masks = dict[tuple[int, int], torch.Tensor]
"""By a view's camera and index, bool `[H, W]`: where some movers show."""


def shown(scene: Scene, tracks: list[Track], frames: Frames) -> Masks:
    """Where held-out frames show some of the tracks."""
    without = replace(scene, actors=tuple(a for a in scene.actors if a.track not in {t.name for t in tracks}))
    masks = {}
    for view, camera in _held_out(scene, frames):
        depth = render_frame(without, camera, ("depth",)).depth
        seen = torch.zeros(camera.height, camera.width, dtype=torch.bool)
        for track in tracks:
            seen |= _shown(track, camera, depth)
        masks[view.camera, view.index] = seen
    return masks


def _held_out(scene: Scene, frames: Frames):
    for c, name in enumerate(frames.names):
        began = dict(zip([v.index for v in frames.views if v.camera == c], scene.frame_times(name).tolist(), strict=True))
        yield from ((view, scene.camera(name, began[view.index])) for view in frames.of(c, held_out=True))


def _shown(track: Track, camera: Camera, depth: torch.Tensor | None) -> torch.Tensor:
    """bool `[H, W]`: the convex hull of a box's corners, where nothing stands nearer."""
    nowhere = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    path = track.trajectory()
    if depth is None or not path.covers(camera.time_us):
        return nowhere
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0, 1)]) * track.size
    pose = (inverse(camera.world_from_cam) @ path.at(camera.time_us)).numpy()
    local = corners @ pose[:3, :3].T + pose[:3, 3]
    if local[:, 2].min() < 0.5:
        return nowhere
    pixels = camera.lens.project(torch.from_numpy(local)).numpy()
    try:
        hull = ConvexHull(pixels)
    except QhullError:
        return nowhere
    if np.ptp(pixels[:, 1]) < TALL:
        return nowhere
    inside = (camera.pixel_centres() @ torch.from_numpy(hull.equations[:, :2].T) + torch.from_numpy(hull.equations[:, 2]) <= 0).all(-1)
    return inside & (depth >= float(local[:, 2].min()))


def masked_psnr(scene: Scene, frames: Frames, rig: dict[str, RigCamera], masks: Masks) -> float:
    """PSNR over all pixels of the masks; nan where there is none."""
    squares, count = 0.0, 0
    for view, camera in _held_out(scene, frames):
        mask = masks[view.camera, view.index]
        if mask.any():
            rgb = render_frame(read_out(scene, camera, rig[frames.names[view.camera]]), camera).rgb
            assert rgb is not None
            off = (rgb - view.image.float() / 255)[mask]
            squares, count = squares + float(off.square().sum()), count + off.numel()
    return -10 * math.log10(squares / count) if count else math.nan


@torch.no_grad()
def told(scene: Scene, frames: Frames, rig: dict[str, RigCamera], masks: dict[str, Masks]) -> dict[str, float]:
    """PSNR of each camera's held-out frames while driving, or of all where it never drives, and of those `masks`."""
    rows = sorted(held_out_table(scene, frames, rig), key=lambda r: r["which"] == "driving")
    return {r["camera"]: r["psnr"] for r in rows} | {of: masked_psnr(scene, frames, rig, m) for of, m in masks.items()}


def fitted(
    log: Log, config: FitConfig, names: list[str], size: tuple[int, int], span: tuple[int, int] | None = None
) -> tuple[Scene, Frames, dict[str, RigCamera], float, Log]:
    """The fitted scene of a span of time, all where None, the frames, the log's cameras, CPU seconds of the fit, and the log by its
    corrected path."""
    span = span or choose(log, names)[1]
    log = readied(log, log.sweeps_within(span), config, names, span, size)
    start, fit = begin(log, names, span, size, config)
    began = time.process_time()
    while fit.step_count < config.steps:
        fit.step()
    spent = time.process_time() - began
    return assemble(fit, start, log), fit.frames, start.rig, spent, log


def depth_errors(scene: Scene, log: Log, sweeps: list[Sweep]) -> str:
    """In percent, as recorded and 2 m aside."""
    rows = off_path_table(scene, log, sweeps, shifts=(0.0, 2.0)) if sweeps else []
    return " / ".join("-" if r["depth_error"] is None else f"{100 * r['depth_error']:.1f}" for r in rows) or "-"


def opened(drive: Path) -> Log:
    if str(drive) != "walk":
        return open_log(drive)
    sys.path.insert(0, str(Path(__file__).parents[1]))  # as pytest does
    from walker import log_of, walk

    return log_of(walk())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--cameras", nargs="+", default=None)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--splats", type=int, default=100_000)
    parser.add_argument("--size", type=int, nargs=2, default=(480, 270))
    parser.add_argument("--only", nargs="+", default=list(PARTS), choices=list(PARTS), metavar="PART")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    log = opened(asked.drive)
    names, span = choose(log, asked.cameras)
    unseen = held_out_sweeps(log, HELD_OUT)
    log, whole_log = replace(log, sweeps=tuple(s for s in log.sweeps if s not in unseen)), log
    asked_about = {s.index for s in unseen if span[0] <= s.time_us <= span[1]}
    config = replace(fit_config(log, names), steps=asked.steps, budget=asked.splats, seed=asked.seed)
    size = (192, 108) if str(asked.drive) == "walk" else (asked.size[0], asked.size[1])
    moving = [t for t in log.tracks if t.moving]
    counted = {"movers": moving, "people": [t for t in moving if t.label in LIMBED]}
    columns = [*names, *counted]
    print(f"{'without':<24}" + "".join(f"{name:>22}" for name in columns) + f"{'depth':>14}{'CPU s':>8}", flush=True)
    whole: dict[str, float] = {}
    masks: dict[str, Masks] = {}
    for what in ("", *asked.only):
        setting: Setting = PARTS[what](log, config) if what else (log, config)
        scene, frames, rig, spent, used = fitted(*setting, names, size)
        with torch.no_grad():
            masks = masks or {of: shown(scene, tracks, frames) for of, tracks in counted.items()}
        found = told(scene, frames, rig, masks)
        whole = whole or found
        cells = ["-" if math.isnan(found[n]) else f"{found[n]:.2f}" + (f" ({found[n] - whole[n]:+.2f})" if what else "") for n in columns]
        there = as_corrected(whole_log, used.meta)
        depth = depth_errors(scene, there, [s for s in there.sweeps if s.index in asked_about])
        print(f"{what or 'nothing':<24}" + "".join(f"{t:>22}" for t in cells) + f"{depth:>14}{spent:>8.0f}", flush=True)


if __name__ == "__main__":
    main()
