"""Reads plain photos or a video: structure from motion finds where they were taken, once, and is kept beside them.

`drives/walk` (a folder of photos in the order of their names, and of the numbers in them) or `drives/walk.mp4` becomes the COLMAP
workspace `drives/walk.sfm`, which is read from then on; delete it to start over. All pictures are taken to share one camera, whose lens is
found too. Photos stay where they are, but where a phone stored any lying on its side: then the workspace holds them all, upright, as it
holds a video's frames.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
from dataclasses import replace
from pathlib import Path

from PIL import ImageOps

from recon.log import FETCH, Log, is_upright
from recon.readers.colmap import WORKSPACE, find_model, kept_of_others, read_colmap
from recon.readers.footage import RATE, Taken, take_frames
from recon.readers.order import recorded
from recon.sfm.solve import solve
from scenes.pictures import PICTURES, opened, rgb_of, swaps_sides

PHOTOS = tuple(suffix for suffix in PICTURES if suffix != ".webp")  # which COLMAP does not read
UNREAD = (".heic", ".heif", ".avif", ".webp", ".gif", ".dng", ".cr2", ".nef", ".arw")
"""Suffixes of pictures that phones, cameras and the web have, and COLMAP does not read."""
VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".m4v", ".webm")
FEWEST = 3
"""Pictures that a world can be made of."""

ASKED = "photos.json"
"""Of a workspace: the names of all photos that there were when it was made, placed or not."""

QUALITY = 95
"""Of a JPEG that is written upright."""

NARROWEST, WIDEST, SAME = math.radians(5), math.radians(150), 0.01
"""Radians of an angle of view that a lens of this kind has, and the part by which two may differ that mean the same."""


def is_photos(path: Path) -> bool:
    return path.is_dir() and len(_photos(path)) >= FEWEST


def check_enough(path: Path) -> None:
    """ValueError where a path is a photo, or holds photos, but fewer than a world can be made of, or such as are not read."""
    count = len(_photos(path)) if path.is_dir() else int(path.is_file() and path.suffix.lower() in PHOTOS)
    if count < FEWEST and (unread := _unread(path)):
        raise ValueError(f"{path} {'holds' if path.is_dir() else 'is'} {unread}, which are not read; export them as .jpg")
    if 0 < count < FEWEST:
        what = f"{'holds' if path.is_dir() else 'is'} {count} photo{'s' * (count > 1)}"
        raise ValueError(f"{path} {what}, and a reconstruction needs at least {FEWEST} of one place; give a folder of as many")


def in_subfolders(path: Path) -> str:
    """A hint to photos in folders below one that holds none, up to two down; "" where there are none."""
    return "" if _photos(path) else _below(path)


def _below(path: Path) -> str:
    """A hint to photos in folders below one, up to two down, but those that its own poses are kept with; "" where there are none."""
    there = [p for level in ("*", "*/*") for p in sorted(path.glob(level)) if p.is_dir() and not p.name.startswith(".")]
    below = [p for p in there if not kept_of_others(path, p)]
    counts = {p: len(photos) for p in below if (photos := _photos(p))}
    if not counts:
        return ""
    most = max(counts, key=lambda p: counts[p])
    told = f"{counts[most]} photos lie in {most}" + f", {sum(counts.values()) - counts[most]} in other folders" * (len(counts) > 1)
    return f" {told}: give that folder, or put all photos of one place into one folder"


def _photos(path: Path) -> list[Path]:
    """A folder's photos in the order they were taken in; what a Mac leaves on a foreign disk (._01.jpg) is none."""
    found = [p for p in path.iterdir() if p.suffix.lower() in PHOTOS and not p.name.startswith(".")]
    return sorted(found, key=lambda p: recorded(p.name))


def _unread(path: Path) -> str:
    """How many pictures at a path are of which kinds that are not read, in words; "" for none."""
    files = path.iterdir() if path.is_dir() else [path]
    kinds = [p.suffix for p in files if p.suffix.lower() in UNREAD and not p.name.startswith(".")]
    return " and ".join(f"{kinds.count(kind)} {kind} picture{'s' * (kinds.count(kind) > 1)}" for kind in dict.fromkeys(kinds))


def is_video(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in VIDEOS


def read_photos(
    path: Path,
    camera_height: float | None = None,
    metres_per_unit: float | None = None,
    angle_of_view: float | None = None,
    part_us: tuple[int, int | None] = (0, None),
) -> Log:
    """The log of a folder of photos or of a video; `camera_height` and `metres_per_unit` as in `read_colmap`.

    angle_of_view: radians from the pictures' left to their right side, found with the poses where None. part_us: start and duration, to the
    end where None, of the part of a video that is read, which has a workspace of its own. ValueError where too few of the
    pictures can be placed, or were placed with another angle before, PermissionError where the workspace cannot be written and
    FileExistsError where something else has its name.
    """
    if angle_of_view is not None and not NARROWEST <= angle_of_view <= WIDEST:
        low, high = (f"{math.degrees(a):.0f}deg" for a in (NARROWEST, WIDEST))
        raise ValueError(f"--angle-of-view must lie from {low} to {high}, got {math.degrees(angle_of_view):g}deg")
    part_us = part_us if is_video(path) else (0, None)
    workspace = path.with_name(path.name + _called(*part_us) + WORKSPACE)
    if find_model(workspace) is None:
        _make(path, workspace, angle_of_view, part_us)
    inside = workspace / "images"
    log = read_colmap(workspace, camera_height, metres_per_unit, inside if inside.is_dir() else path)
    camera = log.camera(log.front[0])
    found = 2 * math.atan(camera.width / 2 / camera.lens.focal()[0])
    if angle_of_view is not None and abs(found - angle_of_view) > SAME * angle_of_view:
        fix = f"delete it to begin again with {math.degrees(angle_of_view):g}deg"
        raise ValueError(f"{workspace} was made with an angle of view of {math.degrees(found):.1f}deg; {fix}")
    if not is_video(path):
        _tell_newer(path, workspace)
        return log
    return replace(log, name=path.name, meta=log.meta | {"name": path.name, "begun_us": 0, "part_us": list(part_us)})


def _tell_newer(path: Path, workspace: Path) -> None:
    """Say which photos have come since a workspace was made of those that there were."""
    there, asked = [p.name for p in _photos(path)], workspace / ASKED
    known = json.loads(asked.read_text()) if asked.is_file() else there  # older workspaces do not say
    if newer := [name for name in there if name not in known]:
        told = f"{len(newer)} of its photos came since {workspace} was made, and {'are' if len(newer) > 1 else 'is'} left out"
        print(f"{path}: {told}: {_some(newer)}; delete {workspace} to place all of them", file=sys.stderr)


def _some(names: list[str]) -> str:
    """The first few of some names."""
    return ", ".join(names[:5]) + f" and {len(names) - 5} more" * (len(names) > 5)


def _called(start_us: int, duration_us: int | None) -> str:
    """What names a part of a video, as .2s+3.5s; "" for the whole."""
    until = "" if duration_us is None else f"+{duration_us / 1e6:g}s"
    return f".{start_us / 1e6:g}s{until}" if start_us or until else ""


def _make(path: Path, workspace: Path, angle_of_view: float | None, part_us: tuple[int, int | None]) -> None:
    """Find the poses and write the workspace: whole, or not at all."""
    if workspace.exists() and not (workspace.is_dir() and not any(workspace.iterdir())):
        raise FileExistsError(f"{workspace} is to hold the poses of {path.name}, and holds something else; move or rename it")
    partial = workspace.with_name(workspace.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir()
    except OSError as problem:
        raise PermissionError(f"cannot write {workspace} ({problem.strerror}); copy {path.name} to a folder that you can write") from None
    try:
        print(f"finding where {path} was taken; it is kept in {workspace}", file=sys.stderr)
        if is_video(path):
            times = _enough(path, take_frames(path, partial / "images", *part_us))
            found = solve(partial / "images", list(times), partial, True, angle_of_view, str(path))
            (partial / "sparse" / "0" / "times.json").write_text(json.dumps(times))
        else:
            names = _of_one_size(path)
            _check_whole(path, names)
            pictures = _upright(path, names, partial / "images")
            found = solve(pictures, names, partial, False, angle_of_view, str(path))
            times = dict.fromkeys(names, 0)
            (partial / ASKED).write_text(json.dumps([p.name for p in _photos(path)]))
            if hint := _below(path):
                print(f"{path}: its own photos were placed;{hint}", file=sys.stderr)
        print(f"placed {found.placed} of {len(times)} pictures", file=sys.stderr)
        if len(found.elsewhere) >= FEWEST:
            print(f"{path}: {_elsewhere(found.elsewhere, times if is_video(path) else None)}", file=sys.stderr)
        if not found.right:
            told = f"only {found.agreed:.0%} of what two pictures share lies where these poses say, and of right ones more than half"
            fix = f"take more pictures, larger ones, with more overlap, and delete {workspace} to begin again"
            fix += ", with --angle-of-view where it is known" if angle_of_view is None else ""
            print(f"{path}: where its pictures were taken may be found wrongly: {told}; {fix}", file=sys.stderr)
        partial.rename(workspace)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _check_whole(path: Path, names: list[str]) -> None:
    """ValueError for a photo of which a part is missing, as of a copy that broke off: COLMAP takes what is left of it, and the fit, which
    does not, begins when all poses are found."""
    for name in names:
        with opened(path / name, str(path / name), f"{FETCH}, or take it away") as picture:
            picture.load()


def _upright(path: Path, names: list[str], folder: Path) -> Path:
    """Where the photos `names` stand upright: their own folder, or where some are turned, `folder`, to which all are written.

    They keep the rest of their EXIF, whose focal length COLMAP asks for. One folder, since a model's pictures have one.
    """
    turned = {name for name in names if not is_upright(path / name)}
    if not turned:
        return path
    folder.mkdir()
    for name in names:
        if name not in turned:
            shutil.copyfile(path / name, folder / name)
            continue
        with opened(path / name, str(path / name), FETCH) as stored:
            upright = ImageOps.exif_transpose(stored)
            rgb_of(upright).save(folder / name, exif=upright.getexif(), quality=QUALITY)
    return folder


def _of_one_size(path: Path) -> list[str]:
    """The photos that share the most common size when upright; the others, from another camera or turned, are left out and said."""
    sizes = {p.name: _size(p) for p in _photos(path)}
    counts = {size: list(sizes.values()).count(size) for size in sizes.values()}
    most = max(counts, key=lambda size: counts[size])
    if counts[most] < FEWEST:
        fix = "scale or cut them to one, as one camera takes them"
        raise ValueError(f"{path} has {len(sizes)} photos, of which no {FEWEST} are of one size in pixels; {fix}")
    others = [name for name, size in sizes.items() if size != most]
    if others:
        print(f"left out {_some(others)}: not {most[0]}x{most[1]} as most photos", file=sys.stderr)
    if unread := _unread(path):
        print(f"left out {unread}, which are not read; export them as .jpg", file=sys.stderr)
    return [name for name, size in sizes.items() if size == most]


def _size(file: Path) -> tuple[int, int]:
    """Width and height of a photo that stands upright."""
    with opened(file, str(file), FETCH) as picture:
        return picture.size[::-1] if swaps_sides(picture) else picture.size


def _enough(path: Path, taken: Taken) -> dict[str, int]:
    """The frames' times. ValueError where they are too few."""
    if len(taken.times) < FEWEST:
        some = "" if len(taken.times) == taken.count else f", of which {len(taken.times)} are taken, {RATE:g} a second"
        frames = f"{taken.count} frame{'s' * (taken.count > 1)}"
        raise ValueError(f"{path} has {frames}{some}; a reconstruction needs at least {FEWEST}: give a longer video")
    return taken.times


def _elsewhere(names: frozenset[str], times: dict[str, int] | None) -> str:
    """What to tell of pictures that share nothing with those that were placed; times: microseconds by name, of a video's."""
    told = f"{len(names)} of its pictures share nothing with these"
    if times is None:
        return f"{told}: {_some(sorted(names, key=recorded))}; put those of another place into another folder"
    first, last = (round(which(times[name] for name in names) / 1e6, 1) for which in (min, max))
    return f"{told}, from {first:g} s to {last:g} s, as before or after a cut; --start and --duration take another part"
