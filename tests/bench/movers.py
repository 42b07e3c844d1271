"""How well movers are found that nobody annotated: a drive's own boxes are hidden, and those found in its lidar held against them.

    python -m tests.bench.movers DRIVE [--reach 50]

A row for each annotated mover that shows at least five points in some sweep within reach: from how near, how far it went, in how many
sweeps it shows, in how many of those more than half of its points lie in a found box, and where that box is: off along and across, and
turned, median and standard deviation. Last, the part of all their points that lie in found boxes, and the found ones that match nothing.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from recon import open_log
from recon.log import Log, Track
from recon.movers.search import with_movers
from recon.objects.actors import MARGIN, inside
from scenes.poses import inverse

FEWEST = 5
"""Points that an object must show in a sweep."""

ROAD = 0.2
"""Metres above a box's floor from which on points are the object's."""

FLOOR = 0.3
"""Metres that a found box may float above the ground."""


@dataclass
class Row:
    """What became of an annotated mover."""

    track: Track
    nearest: float = np.inf
    seen: int = 0
    hit: int = 0
    points: int = 0
    inside: int = 0
    off: list[tuple[str, float, float, float]] = field(default_factory=list)


def rows(log: Log, found: tuple[Track, ...], reach: float) -> Iterator[Row]:
    points = {s.time_us: s.read().xyz for s in log.sweeps}
    for track in (t for t in log.tracks if t.moving):
        row = Row(track)
        for stamp, pose in zip(track.times_us.tolist(), track.world_from_box, strict=True):
            if stamp not in points:
                continue
            back = inverse(pose)
            own = _within(points[stamp], back.numpy(), track.size, 0.0, -ROAD)
            away = float((log.ego.near(stamp)[:3, 3] - pose[:3, 3]).norm())
            if len(own) < FEWEST or away > reach:
                continue
            caught = np.zeros(len(own), dtype=bool)
            for other in found:
                at = np.flatnonzero(other.times_us == stamp)
                if not len(at):
                    continue
                place = other.world_from_box[at[0]]
                there = inverse(place).numpy()
                mine = inside(own @ there[:3, :3].T + there[:3, 3], other.size, MARGIN, FLOOR)
                caught |= mine
                if mine.mean() > 0.5:
                    miss = (back @ place).numpy()
                    row.off.append((other.name, miss[0, 3], miss[1, 3], np.degrees(np.arctan2(miss[1, 0], miss[0, 0]))))
            row.nearest, row.seen, row.hit = min(row.nearest, away), row.seen + 1, row.hit + int(caught.mean() > 0.5)
            row.points, row.inside = row.points + len(own), row.inside + int(caught.sum())
        if row.seen:
            yield row


def _within(xyz: np.ndarray, back: np.ndarray, size: np.ndarray, margin: float, below: float) -> np.ndarray:
    return xyz[inside(xyz @ back[:3, :3].T + back[:3, 3], size, margin, below)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--reach", type=float, default=50.0, help="metres from the car")
    asked = parser.parse_args()
    log = open_log(asked.drive)
    found = with_movers(replace(log, tracks=()), log.sweeps).tracks
    columns = "".join(f"{c:>16}" for c in ("along, m", "across, m", "turned, deg"))
    print(f"{'annotated':<10}{'':<14}{'nearest':>8}{'went':>7}{'sweeps':>8}{'found':>7}{columns}   as")
    told = list(rows(log, found, asked.reach))
    for row in told:
        middles = row.track.world_from_box[:, :2, 3]
        head = f"{row.track.name:<10}{row.track.label:<14}{row.nearest:>6.0f} m{float((middles - middles[0]).norm(dim=1).max()):>5.0f} m"
        off = np.array([o[1:] for o in row.off]).reshape(-1, 3)
        cells = [f"{np.median(c):+.2f} +- {np.std(c):.2f}" if len(c) else "-" for c in off.T]
        names = ", ".join(dict.fromkeys(o[0] for o in row.off))
        print(f"{head}{row.seen:>8}{row.hit:>7}" + "".join(f"{c:>16}" for c in cells) + "   " + names)
    matched = {o[0] for row in told for o in row.off}
    print(f"{100 * sum(r.inside for r in told) / max(sum(r.points for r in told), 1):.1f} % of their points lie in found boxes")
    print("found and not annotated: " + (", ".join(f"{t.name} ({t.label})" for t in found if t.name not in matched) or "none"))


if __name__ == "__main__":
    main()
