"""How well traffic is found that pictures alone show: a drive's boxes and lidar are hidden, and what is found is held against the boxes.

    python -m tests.bench.traffic DRIVE [--camera NAME] [--size 480 270] [--reach 40]

A row for each annotated mover that is in view within reach in some picture: from how near, in how many training pictures, in how many of
those the found box that is nearest is no farther off than `NEAR`, and by how much that is off along and across the annotated one, median
and standard deviation, and its speed. Last, the found ones that match nothing.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from recon import open_log
from recon.begin import begin
from recon.defaults import choose, fit_config
from recon.log import Track
from recon.ready import readied
from scenes.camera import Camera
from scenes.poses import inverse

NEAR = 3.5, 1.5
"""Metres along and across."""


def seen(track: Track, camera: Camera, reach: float) -> float | None:
    """Metres along the line of sight to a box whose middle a camera has in view within reach."""
    if not track.trajectory().covers(camera.time_us):
        return None
    middle = (inverse(camera.world_from_cam) @ track.trajectory().at(camera.time_us))[:3, 3]
    pixel = camera.lens.project(middle)
    inside = 0 <= float(pixel[0]) < camera.width and 0 <= float(pixel[1]) < camera.height
    return float(middle[2]) if inside and 0 < middle[2] < reach else None


def speed(track: Track) -> np.ndarray:
    """Metres a second `[T]` forwards."""
    places, seconds = track.world_from_box[:, :2, 3].numpy(), track.times_us / 1e6
    return (np.gradient(places, seconds, axis=0) * track.world_from_box[:, :2, 0].numpy()).sum(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--camera", default=None)
    parser.add_argument("--size", type=int, nargs=2, default=(480, 270))
    parser.add_argument("--reach", type=float, default=40.0, help="metres from the camera")
    asked = parser.parse_args()
    log = open_log(asked.drive)
    bare = replace(log, sweeps=(), tracks=())
    names, span = choose(bare, [asked.camera] if asked.camera else None)
    config, size = fit_config(bare, names), (asked.size[0], asked.size[1])
    bare = readied(bare, (), config, names, span, size)
    start, fit = begin(bare, names[:1], span, size, config)
    cameras = [fit.frames.camera(bare, v) for v in fit.frames.of(0)]
    matched = set()
    print(f"{'annotated':<10}{'':<12}{'nearest':>8}{'pictures':>10}{'found':>7}{'along, m':>16}{'across, m':>16}{'speed, m/s':>18}   as")
    for track in (t for t in log.tracks if t.moving):
        away, off, paces, by = [], [], [], []
        for camera in cameras:
            if (far := seen(track, camera, asked.reach)) is None:
                continue
            away.append(far)
            there = track.trajectory().at(camera.time_us)
            for other in start.tracks:
                at = np.flatnonzero(other.times_us == camera.time_us)
                if not len(at):
                    continue
                miss = (inverse(there) @ other.world_from_box[at[0]])[:2, 3].numpy()
                if (np.abs(miss) < NEAR).all():
                    off.append(miss)
                    paces.append((speed(other)[at[0]], np.interp(camera.time_us, track.times_us, speed(track))))
                    by.append(other.name)
                    break
        if away:
            matched |= set(by)
            cells = [f"{np.median(c):+.2f} +- {np.std(c):.2f}" if len(off) else "-" for c in np.array(off).reshape(-1, 2).T]
            told, true = np.median(np.array(paces).reshape(-1, 2), axis=0) if paces else (np.nan, np.nan)
            rates = f"{told:.1f} for {true:.1f}" if paces else "-"
            head = f"{track.name:<10}{track.label:<12}{min(away):>6.0f} m{len(away):>10}{len(by):>7}"
            print(head + "".join(f"{c:>16}" for c in cells) + f"{rates:>18}   " + ", ".join(dict.fromkeys(by)))
    print("found and not annotated: " + (", ".join(t.name for t in start.tracks if t.name not in matched) or "none"))


if __name__ == "__main__":
    with torch.no_grad():
        main()
