"""What a path holds, told to a person (`sidestep info`), and what is wrong with it (`sidestep validate`)."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, fields
from pathlib import Path, PurePosixPath
from shlex import quote

import torch

from scenes.asset import Asset
from scenes.databank import Databank, Entry, read_entry
from scenes.files import as_is, kind_of, read, splats_of
from scenes.formats import USD, found
from scenes.formats.trained import model_of
from scenes.gaussians import Gaussians, SplatModel
from scenes.lenses import Lens
from scenes.scene import Scene

LONGEST = 300  # letters of a list or dict on a line with others
FIRST = "name", "licence", "attribution", "source", "clock"  # of a scene's meta, what is shown first
SCALE_RANGE = 1e-6, 1e4  # metres: beyond, a splat is an accident of training or of units


def describe(path: str | os.PathLike) -> dict:
    """A json-like description, in the order to show it: kind, splats, sizes, cameras, actors, licence, warnings, ...

    Values that are not finite are counted under `invalid_splats`, not refused. Errors are those of `load`.
    """
    path = Path(path)
    kind = kind_of(path)
    if path.name in ("scene.usda", "meta.json"):
        path = path.parent
    told: dict = {"path": str(path), "kind": kind, "bytes": _bytes(path)}
    if kind == "databank":
        entries = Databank(path).entries()
        lost = [f"{e.id} lacks {file}" for e in entries for file in _missing(path, e)]
        return told | {"splats": sum(e.splats for e in entries), "entries": [asdict(e) for e in entries], "warnings": lost}
    thing = read(path)
    if isinstance(thing, Gaussians):
        form = found(path)
        model = model_of(path)
        trained = {"model": asdict(model)} if model != SplatModel() else {}
        return told | ({"format": form.name} if form else {}) | trained | _about_splats(thing)
    if isinstance(thing, Asset):
        about = {"label": thing.label, "size": thing.size.tolist(), "model": asdict(thing.model)}
        return told | about | _about_splats(thing.gaussians) | {"meta": thing.meta}
    return told | _about_scene(thing)


def summary(told: dict) -> list[str]:
    """The lines that `sidestep info` prints of a description."""
    return [line for key, value in told.items() for line in _lines(key, value)]


def validate(path: str | os.PathLike, clean: Callable[[Gaussians, str], Gaussians] = as_is) -> list[str]:
    """What is wrong with a scene, databank or splat file, one sentence a problem; [] where nothing is.

    Checks that everything loads, that values are finite and rotations are rotations, that scales are plausible, that no file
    is missing, and runs USD's own validators. With `clean` a `Dropping`, splats that it leaves out are counted there and are no
    problem. FileNotFoundError where the path itself does not exist.
    """
    path = Path(path)
    try:
        kind = kind_of(path)
    except ValueError as error:
        return [str(error)]
    problems: list[str] = []
    if kind == "databank":
        return list(_databank_problems(path, clean))
    try:
        thing = read(path, clean)
    except (ValueError, OSError) as error:
        problems.append(str(error))
    else:
        for name, gaussians in splats_of(thing):
            problems += _splat_problems(gaussians, f"{path}, {name}" if isinstance(thing, Scene) else str(path))
        for asset in [thing] if isinstance(thing, Asset) else [a.asset for a in thing.actors] if isinstance(thing, Scene) else []:
            problems += _photo_problems(asset, str(path))
        if isinstance(thing, Scene):
            problems += _scene_problems(thing, str(path))
    for file in _usd_files(path):
        problems += _usd_problems(file)
    return problems


def _about_splats(gaussians: Gaussians) -> dict:
    valid = gaussians.select(~gaussians.invalid())
    bounds = [valid.means.amin(0).tolist(), valid.means.amax(0).tolist()] if len(valid) else None
    return {"splats": len(gaussians), "sh_degree": gaussians.sh_degree, "bounds": bounds, "invalid_splats": len(gaussians) - len(valid)}


def _about_scene(scene: Scene) -> dict:
    times, places = scene.ego.times_us, scene.ego.world_from_body[:, :3, 3]
    cameras = [
        {
            "name": name,
            "pixels": f"{c.width}x{c.height}",
            "lens": _lens(c.lens),
            **({} if c.shutter == "global" else {"shutter": f"{c.shutter} over {c.readout_us / 1000:g} ms"}),
            "frames": len(c.times_us),
            "seconds": [_seconds(t, times[0]) for t in (c.times_us[[0, -1]] if len(c.times_us) else [])],
        }
        for name, c in scene.rig.items()
    ]
    actors = [
        {
            "track": a.track,
            "label": a.asset.label,
            "size": [round(v, 3) for v in a.asset.size.tolist()],
            "splats": len(a.asset.gaussians),
            "poses": len(a.trajectory),
            **({} if a.deformation is None else {"modes": len(a.deformation.modes)}),
            "seconds": [_seconds(t, times[0]) for t in a.trajectory.times_us[[0, -1]]],
            "inserted": bool(a.asset.meta.get("inserted", False)),
            "edited": bool(a.asset.meta.get("edited", False)),
        }
        for a in scene.actors
    ]
    edits, ground = scene.meta.get("edits", []), scene.ground
    return {
        **{key: scene.meta[key] for key in FIRST if key in scene.meta},
        **_about_splats(scene.background.gaussians),
        "model": asdict(scene.model),
        "ego": {
            "poses": len(scene.ego),
            "seconds": _seconds(times[-1], times[0]),
            "metres": round(float(places.diff(dim=0).norm(dim=-1).sum()), 3),
            "start_us": int(times[0]),
        },
        "cameras": cameras,
        "actors": actors,
        "sky": None if scene.sky is None else f"{scene.sky.linear.shape[1]}x{scene.sky.linear.shape[0]}",
        "ground": None if ground is None else f"{ground.heights.shape[1]}x{ground.heights.shape[0]} cells of {ground.cell:g} m",
        "edits": [{"name": e["name"], **e} for e in edits],
        "warnings": [f"edit {e['name']} is missing: its file was deleted" for e in edits if e.get("missing")],
        "meta": {k: v for k, v in scene.meta.items() if k not in (*FIRST, "edits")},
    }


def _lens(lens: Lens) -> str:
    told = [(f, float(getattr(lens, f.name))) for f in fields(lens)]
    return f"{lens.kind} " + " ".join(f"{f.name}={value:.6g}" for f, value in told if value != f.default)


def _seconds(time_us, start_us) -> float:
    return round((int(time_us) - int(start_us)) / 1e6, 3)


def _lines(key: str, value) -> Iterator[str]:
    label = f"{key.replace('_', ' '):<14} "
    if value is None or value == [] or value == {} or (key == "invalid_splats" and not value):
        return
    if key == "bytes":
        yield f"{'size on disk':<14} {value / 1e6:.2f} MB"
    elif key == "bounds":
        yield label + " to ".join("(" + ", ".join(f"{v:.2f}" for v in corner) + ")" for corner in value)
    elif isinstance(value, list) and isinstance(value[0], dict):
        for i, row in enumerate(value):
            yield (label if i == 0 else " " * len(label)) + "  ".join(_cell(k, v) for k, v in row.items() if _cell(k, v))
    elif isinstance(value, dict):
        yield label + "  ".join(f"{k} {_brief(v)}" for k, v in value.items())
    elif isinstance(value, list):
        yield label + ", ".join(str(v) for v in value)
    else:
        yield label + str(value)


def _brief(value) -> str:
    """A value of a dict on one line with others: of what is long, or a list of records, only how many; --json has them all."""
    records = isinstance(value, list) and any(isinstance(v, dict) for v in value)
    long = isinstance(value, list | dict) and len(str(value)) > LONGEST
    return f"({len(value)} entries, see --json)" if records or long else str(value)


def _cell(key: str, value) -> str:
    """One value of a table row; flags that are off, empty values and paths inside a databank are left out."""
    if value is None or value is False or value == "" or value == [] or key in ("asset", "thumb"):
        return ""
    if key == "size":
        return "x".join(f"{v:.2f}" for v in value) + " m"
    if key == "seconds":
        return f"{value[0]:g} to {value[1]:g} s"
    if key in ("name", "track", "id", "label", "pixels", "lens", "shutter", "licence"):
        return str(value)
    if value is True:
        return key
    return f"{value} {key}" if key in ("splats", "views", "frames", "poses") else f"{key} {value}"


def _splat_problems(gaussians: Gaussians, where: str) -> Iterator[str]:
    try:
        gaussians.validate(where)
    except ValueError as error:
        yield str(error)
    scales = gaussians.log_scales.to(torch.float64).exp().nan_to_num(1.0)
    odd = ((scales < SCALE_RANGE[0]) | (scales > SCALE_RANGE[1])).any(1)
    if odd.any():
        first = int(odd.nonzero()[0])
        values = ", ".join(f"{v:.3g}" for v in scales[first].tolist())
        low, high = SCALE_RANGE
        yield f"{where}: splat {first} has the scales {values} m, outside {low:g} to {high:g}; {int(odd.sum())} such splats in all"


def _scene_problems(scene: Scene, where: str) -> Iterator[str]:
    poses = {"background": scene.background.world_from_local, "ego": scene.ego.world_from_body}
    poses |= {f"actor {a.track}": a.trajectory.world_from_body for a in scene.actors}
    poses |= {f"camera {name}": c.body_from_cam for name, c in scene.rig.items()}
    for name, pose in poses.items():
        if not torch.isfinite(pose).all():
            yield f"{where}: the pose of {name} is not finite"
    if not scene.rig:
        yield f"{where}: there is no camera"
    for name, camera in scene.rig.items():
        if (camera.times_us.diff() <= 0).any():
            at = int((camera.times_us.diff() <= 0).nonzero()[0]) + 1
            yield f"{where}: the times of camera {name} must rise, but frame {at} is taken no later than the one before"
        early = [int(t) for t in camera.times_us if not scene.ego.covers(int(t))]
        if early:
            yield f"{where}: camera {name} took {len(early)} frames when the body's pose is unknown, the first at {early[0]} us"
        if not torch.isfinite(camera.exposure).all():
            yield f"{where}: the exposure of camera {name} is not finite"
        if camera.gains is not None and not (camera.gains.isfinite() & (camera.gains > 0)).all():
            yield f"{where}: camera {name} has a frame whose gain is not a positive number"
        if camera.flat_field is not None and not (camera.flat_field.isfinite() & (camera.flat_field > 0)).all():
            yield f"{where}: the flat field of camera {name} has gains that are not positive numbers"
    if scene.ground is not None and not torch.isfinite(scene.ground.heights).all():
        yield f"{where}: the ground has heights that are not finite"
    for edit in scene.meta.get("edits", []):
        if edit.get("missing"):
            name = edit["name"]
            fix = f"sidestep edit {quote(str(where))} --undo {name}"
            yield f"{where}: edit {name} is undone, but not tidied up: edits/{name}.usda was deleted; {fix} takes away the rest"


def _databank_problems(path: Path, clean: Callable[[Gaussians, str], Gaussians]) -> Iterator[str]:
    try:
        bank = Databank(path)
        entries = bank.entries()
    except (ValueError, OSError) as error:
        yield str(error)
        return
    for entry in entries:
        lost = _missing(path, entry)
        yield from (f"{entry.id} lacks its file {file}" for file in lost)
        file = path / entry.asset
        if {file, file.with_name("asset.json")} & set(lost):
            continue
        try:
            read_entry(file.with_name("asset.json"))
            asset = bank.load(entry.id, clean)
        except (ValueError, OSError) as error:
            yield str(error)
            continue
        yield from _splat_problems(asset.gaussians, entry.id)
        yield from _photo_problems(asset, entry.id)
        counted = clean is not as_is or len(asset.gaussians) == entry.splats
        if not counted or asset.label != entry.label or asset.size.tolist() != list(entry.size):
            yield f"{entry.id} differs from what index.json says of it: {len(asset.gaussians)} splats, {asset.label}, {asset.size.tolist()}"
        yield from _usd_problems(file)
    known = {path / Path(e.asset).parent for e in entries}
    yield from (f"{p.parent} is not in index.json" for p in sorted(path.glob("assets/*/*/asset.usdc")) if p.parent not in known)


def _photo_problems(asset: Asset, where: str) -> Iterator[str]:
    for photo in asset.photos:
        try:
            photo.read()
        except (ValueError, OSError) as error:
            yield f"{where}: {error}"


def _missing(bank: Path, entry: Entry) -> list[Path]:
    told = str(PurePosixPath(entry.asset).with_name("asset.json"))
    return [bank / file for file in (entry.asset, told, entry.thumb) if file and not (bank / file).is_file()]


def _usd_files(path: Path) -> list[Path]:
    """The USD files that stand for a path: a scene's root and its edits, an asset's file, or the file itself."""
    if path.is_dir():
        edits = (p for p in sorted(path.glob("edits/*.usda")) if not p.name.startswith("."))  # as what a killed edit was writing does
        return [*(p for p in (path / "scene.usda", path / "asset.usdc") if p.is_file()), *edits]
    return [path] if found(path) is USD else []


def _usd_problems(file: Path) -> list[str]:
    from scenes.usd.layers import usd_problems

    try:
        return [f"{file}: {problem}" for problem in usd_problems(file)]
    except (ValueError, OSError) as error:
        return [str(error)]


def _bytes(path: Path) -> int:
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    return sum(p.stat().st_size for p in files)
