"""metadata.json of a scene folder: what USD cannot carry exactly, and what tells that a folder is a scene."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np

from scenes.names import absent
from scenes.scene import Scene
from scenes.usd.splats import to_json

FORMAT = "sidestep scene"

VERSION = 1


def is_scene(path: Path) -> bool:
    """Whether a path is a scene folder that this project wrote."""
    try:
        return json.loads((path / "metadata.json").read_text(encoding="utf-8"))["format"] == FORMAT
    except (OSError, ValueError, KeyError, TypeError):
        return False


def read_metadata(path: Path) -> dict:
    """metadata.json of a scene folder. FileNotFoundError or ValueError saying what is wrong with it."""
    file = path / "metadata.json"
    if not path.exists():
        raise FileNotFoundError(absent(path))
    if not file.is_file():
        raise FileNotFoundError(f"{path} is not a Sidestep scene: it has no metadata.json")
    try:
        meta = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file} is corrupt: {error}") from error
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        raise ValueError(f'{file} is not a Sidestep scene\'s: its "format" is not "{FORMAT}"')
    if meta.get("version") != VERSION:
        raise ValueError(f"{file} has version {meta.get('version')}; this Sidestep reads version {VERSION}")
    return meta


def metadata_text(scene: Scene, cameras: dict[str, str], origin: int) -> str:
    """metadata.json of a scene. cameras: their prims' names; origin: microseconds at time code 0."""
    table = {
        name: {
            "prim": cameras[name],
            "lens": {"type": c.lens.kind, **{f.name: float(getattr(c.lens, f.name)) for f in fields(c.lens)}},
            "width": c.width,
            "height": c.height,
            "exposure": c.exposure.detach().cpu().tolist(),
            "times_us": c.times_us.tolist(),
            "shutter": c.shutter,
            "readout_us": c.readout_us,
            "gains": None if c.gains is None else c.gains.detach().cpu().tolist(),
            "fitted": c.fitted,
            "flat_field": None if c.flat_field is None else c.flat_field.detach().cpu().tolist(),
        }
        for name, c in scene.rig.items()
    }
    meta = {k: v for k, v in scene.meta.items() if k != "edits"}  # edits become part of what is written
    model = asdict(scene.model)
    whole = {"format": FORMAT, "version": VERSION, "origin_us": origin, "model": model, "cameras": table, "meta": meta}
    return to_json(whole, "the scene's meta")


def check_parked(entries: list[dict], file: Path) -> None:
    """ValueError where an entry of a scene's `parked` vehicles is no box of finite numbers with a track and a label."""
    for i, entry in enumerate(entries):
        try:
            named = isinstance(entry["track"], str) and isinstance(entry["label"], str)
            box = *np.asarray(entry["size"], float).reshape(3), *np.asarray(entry["world_from_box"], float).reshape(16)
        except (KeyError, TypeError, ValueError):
            named, box = False, ()
        if not named or not np.isfinite(box).all():
            needs = "a track, a label, a size of 3 and a world_from_box of 4x4 finite numbers"
            raise ValueError(f"{file} is corrupt: entry {i} of parked needs {needs}; restore the file, or take the entry out")
