"""What each part of a fit is worth: held-out PSNR of short fits of one drive with it and without.

    python -m tests.bench.recon DRIVE [--cameras NAME ...] [--steps 1200] [--splats 100000] [--size 480 270] [--only PART ...]

The first row is the whole fit; every other one leaves one part out and says what that costs, over held-out frames while the car drives.
The same seed draws the same views in all of them; two runs of one row differ by 0.03 dB where only the seed does.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from recon import open_log
from recon.build import assemble, begin, choose
from recon.fit import FitConfig
from recon.log import Log
from recon.report import held_out_table

Setting = tuple[Log, FitConfig]
PARTS: dict[str, Callable[[Log, FitConfig], Setting]] = {}


def part(leave_out: Callable[[Log, FitConfig], Setting]) -> Callable[[Log, FitConfig], Setting]:
    PARTS[leave_out.__name__.replace("_", " ")] = leave_out
    return leave_out


@part
def rolling_shutter(log: Log, config: FitConfig) -> Setting:
    instant = {name: replace(camera, shutter="global", readout_us=0) for name, camera in log.cameras.items()}
    return replace(log, cameras=instant), config


def _unrefined(what: str) -> None:
    def leave_out(log: Log, config: FitConfig) -> Setting:
        return log, replace(config, refine=tuple(r for r in config.refine if r != what))

    PARTS[f"refinement of {what}"] = leave_out


for kind in FitConfig().refine:
    _unrefined(kind)


def held_out_psnr(log: Log, config: FitConfig, names: list[str], size: tuple[int, int]) -> tuple[dict[str, float], float]:
    """PSNR of each camera's held-out frames while driving, or of all where it never drives, and CPU seconds of the fit."""
    _, span = choose(log, names)
    start, fit = begin(log, names, span, size, config)
    began = time.process_time()
    while fit.step_count < config.steps:
        fit.step()
    spent = time.process_time() - began
    rows = held_out_table(assemble(fit, start, log), fit.frames, start.rig)
    return {r["camera"]: r["psnr"] for r in sorted(rows, key=lambda r: r["which"] == "driving")}, spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--cameras", nargs="+", default=None)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--splats", type=int, default=100_000)
    parser.add_argument("--size", type=int, nargs=2, default=(480, 270))
    parser.add_argument("--only", nargs="+", default=list(PARTS), choices=list(PARTS), metavar="PART")
    asked = parser.parse_args()
    log, config = open_log(asked.drive), FitConfig(steps=asked.steps, budget=asked.splats)
    names, _ = choose(log, asked.cameras)
    print(f"{'without':<24}" + "".join(f"{name:>22}" for name in names) + f"{'CPU s':>8}", flush=True)
    whole: dict[str, float] = {}
    for what in ("", *asked.only):
        setting: Setting = PARTS[what](log, config) if what else (log, config)
        found, spent = held_out_psnr(*setting, names, (asked.size[0], asked.size[1]))
        whole = whole or found
        told = [f"{found[n]:.2f}" + (f" ({found[n] - whole[n]:+.2f})" if what else "") for n in names]
        print(f"{what or 'nothing':<24}" + "".join(f"{t:>22}" for t in told) + f"{spent:>8.0f}", flush=True)


if __name__ == "__main__":
    main()
