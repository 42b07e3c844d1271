"""What a step of the fit costs, and where: milliseconds of wall clock and of all cores together, for each size of picture.

    python -m tests.bench.steps DRIVE [--cameras NAME ...] [--steps 40] [--threads 2]

Parts that hold others are listed before them. The splats are those that the fit starts from, so a finished fit's steps cost more.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import torch

import recon.fit.fit
import render.bridge
from recon import open_log
from recon.begin import begin
from recon.defaults import choose, fit_config, fit_size
from recon.fit.descent import Descent
from recon.fit.develop import Develop
from recon.fit.fit import Fit
from recon.fit.flat import FlatGround
from recon.fit.losses import PictureLoss
from recon.fit.motion import Motion
from recon.fit.openings import Openings
from render.bridge import Rasterize

PARTS = [
    (Fit, "step"), (Motion, "shot"), (Fit, "_in_sight"), (recon.fit.fit, "in_sight"), (Descent, "catch_up"), (Fit, "_render"),
    (Motion, "as_read"), (Rasterize, "forward"), (render.bridge, "draw"), (Develop, "forward"),
    (PictureLoss, "forward"), (Openings, "gaps"), (torch.Tensor, "backward"), (Rasterize, "backward"), (render.bridge, "draw_backward"),
    (Openings, "haze"), (Develop, "backward"), (Descent, "follow"), (FlatGround, "press"), (Fit, "_follow"),
]  # fmt: skip


def timed(owner, name: str, wall: Counter, spent: Counter) -> None:
    """Have calls of `owner.name` count their time in `wall` and `spent`."""
    plain, key = getattr(owner, name), f"{owner.__name__.split('.')[-1]}.{name}"

    def call(*args, **kwargs):
        began, busy = time.perf_counter(), time.process_time()
        try:
            return plain(*args, **kwargs)
        finally:
            wall[key] += time.perf_counter() - began
            spent[key] += time.process_time() - busy

    setattr(owner, name, staticmethod(call) if isinstance(owner.__dict__[name], staticmethod) else call)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--cameras", nargs="+", default=None)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--threads", type=int, default=2)
    asked = parser.parse_args()
    torch.set_num_threads(asked.threads)
    log = open_log(asked.drive)
    names, span = choose(log, asked.cameras)
    config = replace(fit_config(log, names), grow_span=(2.0, 2.0))
    _, fit = begin(log, names, span, fit_size(log, names), config)
    wall: Counter = Counter()
    spent: Counter = Counter()
    for owner, name in PARTS:
        timed(owner, name, wall, spent)
    for start, factor in config.stages:
        fit.step_count = round(max(start, config.poses_from) * config.steps)
        for count in (5, asked.steps):  # the first few compile, and fill caches
            wall.clear()
            spent.clear()
            for _ in range(count):
                fit.step()
        width, height = fit.targets.size(fit.training[0], factor)
        print(f"{width}x{height}, {len(fit.splats)} splats{'wall ms':>22}{'CPU ms':>10}")
        for key in (f"{owner.__name__.split('.')[-1]}.{name}" for owner, name in PARTS):
            print(f"  {key:<36}{1e3 * wall[key] / asked.steps:>10.1f}{1e3 * spent[key] / asked.steps:>10.1f}")


if __name__ == "__main__":
    main()
