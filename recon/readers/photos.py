"""Reads plain photos or a video: structure from motion finds where they were taken, once, and is kept beside them.

`drives/walk` (a folder of photos in the order of their names) or `drives/walk.mp4` becomes the COLMAP workspace `drives/walk.sfm`, which is
read from then on; delete it to start over. All pictures are taken to share one camera, whose lens is found too.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
from pathlib import Path

from recon.log import Log, image_size
from recon.readers.colmap import find_model, read_colmap
from recon.readers.sfm import solve

PHOTOS = (".jpg", ".jpeg", ".png")
VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".m4v", ".webm")
FEWEST = 3
"""Pictures that a world can be made of."""

RATE, MOST = 10.0, 150
"""Frames a second that are taken from a video, and how many of it at most: more say little more, and matching takes long."""

NARROWEST, WIDEST, SAME = math.radians(5), math.radians(150), 0.01
"""Radians of an angle of view that a lens of this kind has, and the part by which two may differ that mean the same."""


def is_photos(path: Path) -> bool:
    return path.is_dir() and sum(p.suffix.lower() in PHOTOS for p in path.iterdir()) >= FEWEST


def is_video(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in VIDEOS


def read_photos(
    path: Path, camera_height: float | None = None, metres_per_unit: float | None = None, angle_of_view: float | None = None
) -> Log:
    """The log of a folder of photos or of a video; `camera_height` and `metres_per_unit` as in `read_colmap`.

    angle_of_view: radians from the pictures' left to their right side, found with the poses where None. ValueError where too few of the
    pictures can be placed, or were placed with another angle before, PermissionError where the workspace cannot be written.
    """
    if angle_of_view is not None and not NARROWEST <= angle_of_view <= WIDEST:
        low, high = (f"{math.degrees(a):.0f}deg" for a in (NARROWEST, WIDEST))
        raise ValueError(f"--angle-of-view must lie from {low} to {high}, got {math.degrees(angle_of_view):g}deg")
    workspace = path.with_name(path.name + ".sfm")
    if find_model(workspace) is None:
        _make(path, workspace, angle_of_view)
    pictures = workspace / "images" if is_video(path) else path
    log = read_colmap(workspace, camera_height, metres_per_unit, pictures)
    camera = log.camera(log.front[0])
    found = 2 * math.atan(camera.width / 2 / camera.lens.focal()[0])
    if angle_of_view is not None and abs(found - angle_of_view) > SAME * angle_of_view:
        fix = f"delete it to begin again with {math.degrees(angle_of_view):g}deg"
        raise ValueError(f"{workspace} was made with an angle of view of {math.degrees(found):.1f}deg; {fix}")
    return log


def _make(path: Path, workspace: Path, angle_of_view: float | None) -> None:
    """Find the poses and write the workspace: whole, or not at all."""
    partial = workspace.with_name(workspace.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir()
    except OSError as problem:
        raise PermissionError(f"cannot write {workspace} ({problem.strerror}); copy {path.name} to a folder that you can write") from None
    try:
        print(f"finding where {path} was taken; it is kept in {workspace}", file=sys.stderr)
        if is_video(path):
            times = _frames(path, partial / "images")
            placed = solve(partial / "images", list(times), partial, True, angle_of_view)
            (partial / "sparse" / "0" / "times.json").write_text(json.dumps(times))
        else:
            names = _of_one_size(path)
            placed = solve(path, names, partial, False, angle_of_view)
            times = dict.fromkeys(names, 0)
        print(f"placed {placed} of {len(times)} pictures", file=sys.stderr)
        partial.rename(workspace)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _of_one_size(path: Path) -> list[str]:
    """The photos that share the most common size; the others, from another camera or turned, are left out and said."""
    sizes = {p.name: image_size(p) for p in sorted(path.iterdir()) if p.suffix.lower() in PHOTOS}
    counts = {size: list(sizes.values()).count(size) for size in sizes.values()}
    most = max(counts, key=lambda size: counts[size])
    others = [name for name, size in sizes.items() if size != most]
    if others:
        print(f"left out {', '.join(others[:5])}: not {most[0]}x{most[1]} as most photos", file=sys.stderr)
    return [name for name, size in sizes.items() if size == most]


def _frames(path: Path, folder: Path) -> dict[str, int]:
    """Write frames of a video to `folder`, evenly over it; their times in microseconds by name."""
    from render.video import read_video, write_image

    folder.mkdir()
    video = read_video(path)
    count = video.count or sum(1 for _ in video)
    rate = min(RATE, MOST * video.fps / count)
    step = max(1, math.ceil(video.fps / rate - 0.5))
    times = {}
    for i, frame in enumerate(video):
        if i % step == 0:
            write_image(folder / f"{i:06d}.jpg", frame)
            times[f"{i:06d}.jpg"] = round(i * 1e6 / video.fps)
    if len(times) < FEWEST:
        raise ValueError(f"{path} has {count} frames; a world needs at least {FEWEST}")
    return times
