"""A drive as if something of it were otherwise, fitted for a short time: what is taken for granted because a test drive has it.

    python -m tests.bench.otherwise DRIVE [--camera front_camera] [--only NAME ...] [--start 3s] [--duration 4s] [--steps 1000]
        [--splats 80000] [--size 480 270] [--without KIND ...]

DRIVE has lidar and boxes. Held-out pictures are those of the drive that is fitted, so that darker ones have more dB. Everything else is as
`sidestep recon` reports it of held-out sweeps, on the path and 3 m aside; where boxes are what is otherwise, movers are measured in those
recorded, and where the path is, by the sweeps as recorded, laid on it as a whole. Names are of the functions in changed_records.py and
changed_pictures.py, as in "half rate". --without: what is not put right, as "surfaces", by which cameras are found turned, or their clock
late.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from recon.defaults import HELD_OUT, choose
from recon.evaluation.offpath import held_out_sweeps, off_path_table
from recon.evaluation.report import held_out_table
from recon.fit.config import FitConfig
from recon.log import Log, mean_pose
from recon.ready import fitted as without_held_out
from recon.registration.corrected import as_corrected, moved
from scenes.poses import inverse
from scenes.trajectory import Trajectory
from scenes.units import duration_us
from tests.bench import changed_pictures, changed_records  # noqa: F401 - they fill CHANGES
from tests.bench.changes import CHANGES, Change
from tests.bench.recon import fitted, opened

ASIDE = 3.0
"""Metres."""

HEADS = (
    "",
    "held out, dB",
    "depth error, as recorded",
    f"{ASIDE:g} m aside",
    "movers' depth",
    "road, dB",
    f"{ASIDE:g} m aside",
    "flicker",
)


def measured_by(recorded: Log, otherwise: Log, used: Log, spoilt: str) -> Log:
    """The sweeps and boxes by which a scene is measured, all of them, in its world. used: the drive `otherwise` as it was fitted."""
    if spoilt == "path":
        off = used.ego.world_from_body @ inverse(recorded.ego.world_from_body)
        return moved(recorded, Trajectory(torch.tensor([0]), mean_pose(off)[None]))
    return as_corrected(replace(otherwise, tracks=recorded.tracks) if spoilt == "boxes" else otherwise, used.meta)


def row(recorded: Log, change: Change, name: str, part_us: tuple[int, int], config: FitConfig, size: tuple[int, int]) -> list[str]:
    """The cells of a drive otherwise, fitted: of camera `name`, from so many microseconds of the recording on for so many."""
    otherwise = change.make(recorded)
    names, span = choose(otherwise, [name], *(round(t * change.clock) for t in part_us))
    scene, frames, rig, _, used = fitted(without_held_out(otherwise, HELD_OUT), config, names, size, span)
    held_out = {r["which"]: r["psnr"] for r in held_out_table(scene, frames, rig)}
    there = measured_by(recorded, otherwise, used, change.spoilt)
    unseen = [s for s in held_out_sweeps(otherwise, HELD_OUT) if span[0] <= s.time_us <= span[1]]
    indices = {s.index for s in unseen}
    path, aside = off_path_table(scene, there, [s for s in there.sweeps if s.index in indices], frames, (0.0, ASIDE))
    return [
        f"{held_out.get('driving', held_out['all']):.2f}",
        *(_told(r["depth_error"], 100, "{:.2f} %") for r in (path, aside)),
        _told(path["movers_error"], 100, "{:.2f} %"),
        *(_told(r["road"], 1, "{:.1f}") for r in (path, aside)),
        f"{path['flicker']:.2f}",
    ]


def _told(value: float | None, times: float, how: str) -> str:
    return "-" if value is None else how.format(times * value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--camera", default="front_camera")
    parser.add_argument("--only", nargs="+", default=list(CHANGES), choices=list(CHANGES), metavar="NAME")
    parser.add_argument("--start", type=duration_us, default="3s")
    parser.add_argument("--duration", type=duration_us, default="4s")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--splats", type=int, default=80_000)
    parser.add_argument("--size", type=int, nargs=2, default=(480, 270), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--without", nargs="+", default=[], choices=FitConfig().refine, metavar="KIND")
    asked = parser.parse_args()
    log, config = opened(asked.drive), FitConfig(steps=asked.steps, budget=asked.splats).without(*asked.without)
    print(f"| {' | '.join(HEADS)} |\n|{'---|' * len(HEADS)}", flush=True)
    for name in asked.only:
        change = CHANGES[name]
        cells = row(log, change, asked.camera, (asked.start, asked.duration), config, (asked.size[0], asked.size[1]))
        print(f"| {name}: {change.what} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
