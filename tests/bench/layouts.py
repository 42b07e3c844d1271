"""One drive as other data sets would have published it: written in their layouts, read again, fitted and measured.

    python -m tests.bench.layouts DRIVE -o FOLDER [--only pandaset nuscenes argoverse2 waymo kitti] [--camera front_camera]

Of frames 24 to 75 of a PandaSet drive one camera's pictures are written, as they are, with its boxes and with made-up lidars such as these
data sets have (`tests/layouts/lidar.py`), which show what the sweeps that are not held out do. The car's path is that by which these sweeps
meet, its camera is fixed to it. What is in FOLDER already is read as it is. Each is fitted for 4 seconds from frame 30 on, at 480x270, with
1,000 steps and 80,000 splats, and measured by PandaSet's own held-out pictures and sweeps, carried to where the car was; the first row is
PandaSet itself, of the same frames. "Movers' boxes" are all pixels of held-out pictures in the boxes of what moves, where the first row's
scene without them shows nothing nearer.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from recon import open_log
from recon.defaults import HELD_OUT, choose, fit_config
from recon.evaluation.offpath import off_path_table
from recon.log import LidarPoints, Log, Sweep, Track, mean_pose
from recon.ready import fitted as without_held_out
from recon.registration.align import aligned
from recon.registration.corrected import moved
from scenes.atomic import atomic_folder
from scenes.poses import inverse
from scenes.trajectory import Trajectory
from tests.bench.recon import Masks, fitted, shown, told
from tests.layouts import argoverse2, kitti, nuscenes, waymo
from tests.layouts.lidar import Spinner, Street, boxes, sweep

FRAMES, START, LASTS_US = range(24, 76), 30, 4_000_000
STEPS, SPLATS, SIZE = 1000, 80_000, (480, 270)
HEADS = (
    "", "vehicles that move", "held out, dB", "in movers' boxes", "depth error, as recorded", "3 m aside", "in the way", "3 m aside",
    "movers'", "above, 3 m", "road, dB", "3 m aside",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Layout:
    """What a data set records. lidars: those on the car, which turn together; write: puts a log into a folder, below which `opens` is what
    is read; turns: so many a picture; stamped: the part of a turn after which a sweep has its stamp; annotated: every how many sweeps boxes
    are drawn."""

    lidars: tuple[Spinner, ...]
    write: Callable[[Path, Log], Path]
    opens: str = ""
    turns: int = 1
    stamped: float = 0.0
    annotated: int = 1


def _beams(low: float, high: float, count: int) -> np.ndarray:
    return np.radians(np.linspace(low, high, count))


HDL32 = Spinner((0.0, 0.0, 1.84), _beams(-30, 10, 32), 1090, 50_000, True, 80.0)
VLP32 = Spinner((0.0, 0.0, 1.64), _beams(-30, 10, 32), 1800, 100_000, True, 150.0)
TOP = Spinner((0.0, 0.0, 2.18), _beams(-17.6, 2.4, 64), 2650, 100_000, True, 75.0)
HDL64 = Spinner((0.0, 0.0, 1.43), _beams(-24.8, 2.0, 64), 2083, 100_000, False, 120.0)
HALF = float(VLP32.beams[1] - VLP32.beams[0]) / 2

LAYOUTS = {
    "nuscenes": Layout(
        (HDL32,), partial(nuscenes.write, body_from_lidar=HDL32.body_from_lidar), nuscenes.SCENE, turns=2, stamped=1.0, annotated=10
    ),
    "argoverse2": Layout((VLP32, replace(VLP32, place=(0.0, 0.0, 1.54), beams=VLP32.beams + HALF)), argoverse2.write),
    "waymo": Layout((TOP,), partial(waymo.write, body_from_lidar=TOP.body_from_lidar, beams=TOP.beams, columns=TOP.columns), waymo.SEGMENT),
    "kitti": Layout((HDL64,), partial(kitti.write, body_from_lidar=HDL64.body_from_lidar), kitti.DRIVE, stamped=0.5),
}
"""Boxes twice a second and a lidar 20 times in nuScenes; range images in Waymo's; a lidar that looks ahead at its stamp in KITTI's.
PandaSet's body is 0.3 m above the road."""

ROWS = ["pandaset", *LAYOUTS]


def part_of(log: Log, name: str, frames: range) -> Log:
    """The log with one camera and these of its frames, and with the sweeps and boxes of the same numbers."""
    camera = log.camera(name).part(slice(frames.start, frames.stop))
    sweeps = tuple(s for s in log.sweeps if s.index in frames)
    first, last = sweeps[0].time_us, sweeps[-1].time_us
    tracks = []
    for track in log.tracks:
        kept = (first <= track.times_us) & (track.times_us <= last)
        if kept.any():
            tracks.append(track.part(kept))
    return replace(log, cameras={name: camera}, sweeps=sweeps, tracks=tuple(tracks), front=(name,))


def recorded(log: Log, street: Street, name: str, layout: Layout) -> Log:
    """What another data set's car would have recorded of a street on a log's path: its camera is called front, and its lidars look where
    that does when it takes its pictures."""
    lidar = layout.lidars[0]
    camera, mount = log.camera(name), mean_pose(log.offsets(name))
    fixed = replace(camera, name="front", world_from_cam=log.ego.at_each(camera.times_us) @ mount)
    before = round(float(lidar.passes(mount[None, :3, 2].numpy())[0]) * lidar.turn_us)
    begun = [t - before + k * lidar.turn_us for t in camera.times_us.tolist() for k in range(layout.turns)]
    stamps = [t + round(layout.stamped * lidar.turn_us) for t in begun]

    def turned(begun_us: int) -> LidarPoints:
        parts = [sweep(street, each, log.ego, begun_us, k) for k, each in enumerate(layout.lidars)]
        return LidarPoints(*(np.concatenate([getattr(p, field) for p in parts]) for field in ("xyz", "times_us", "sensor")))

    sweeps = tuple(Sweep(i, stamp, partial(turned, t)) for i, (t, stamp) in enumerate(zip(begun, stamps, strict=True)))
    drawn = boxes(street, lidar, log.ego, begun[:: layout.annotated], stamps[:: layout.annotated])
    lidars = {k: np.array(each.place) for k, each in enumerate(layout.lidars)}
    return Log("front", log.path, {"front": fixed}, sweeps, drawn, log.ego, {}, lidars=lidars)


def carried(log: Log, new: Trajectory) -> Log:
    """A log moved to where its car is by another path of the same body."""
    times = torch.tensor([s.time_us for s in log.sweeps])
    return moved(log, Trajectory(times, new.near_each(times) @ inverse(log.ego.near_each(times))))


def row(title: str, log: Log, truth: Log, seen: list[Masks]) -> str:
    """A line of the table: a log that is read, fitted and measured by the held-out sweeps of `truth`. seen: the pixels that show movers,
    which the first row finds."""
    name = log.front[0]
    times = log.camera(name).times_us
    names, span = choose(log, [name], int(times[START - FRAMES.start] - times[0]), LASTS_US)
    config = replace(fit_config(log, names, span), steps=STEPS, budget=SPLATS)
    scene, frames, rig, _, used = fitted(log, config, names, SIZE, span)
    there = carried(truth, used.ego)
    tracks: list[Track] = [t for t in there.tracks if t.moving]
    with torch.no_grad():
        seen[:] = seen or [shown(scene, tracks, frames)]
    found = told(scene, frames, rig, {"movers": seen[0]})
    unseen = [s for s in there.sweeps if s.index % HELD_OUT == HELD_OUT // 2 and span[0] <= s.time_us <= span[1]]
    here, aside = off_path_table(scene, there, unseen, frames, shifts=(0.0, 3.0))
    vehicles = sum(t.moving and t.name.startswith("veh") for t in used.tracks)
    cells = [title, str(vehicles), f"{found[name]:.2f}", f"{found['movers']:.2f}"]
    cells += [f"{100 * r[key]:.2f} %" for key in ("depth_error", "in_the_way") for r in (here, aside)]
    cells += [f"{100 * here['movers_error']:.2f} %", f"{100 * aside['holes_above']:.2f} %", *(f"{r['road']:.2f}" for r in (here, aside))]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--only", nargs="+", default=ROWS, choices=ROWS, metavar="LAYOUT")
    parser.add_argument("--camera", default="front_camera")
    asked = parser.parse_args()
    part = part_of(open_log(asked.drive), asked.camera, FRAMES)
    kept = without_held_out(part, HELD_OUT)
    meets = aligned(part, kept.sweeps)
    seen: list[Masks] = []
    print(f"| {' | '.join(HEADS)} |\n|{len(HEADS) * '---|'}", flush=True)
    if "pandaset" in asked.only:
        print(row("PandaSet", kept, meets, seen), flush=True)
    asked.output.mkdir(exist_ok=True)
    street = None
    for name in (n for n in LAYOUTS if n in asked.only):
        root = asked.output / name
        if not root.exists():
            street = street or Street.of(meets, without_held_out(meets, HELD_OUT).sweeps)
            with atomic_folder(root) as folder:
                folder.rmdir()  # the writers make it
                LAYOUTS[name].write(folder, recorded(meets, street, asked.camera, LAYOUTS[name]))
        print(row(name, open_log(root / LAYOUTS[name].opens), meets, seen), flush=True)


if __name__ == "__main__":
    main()
