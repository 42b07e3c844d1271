"""What several sub-commands do: refuse what stands, open a scene, warn."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scenes import Asset, Gaussians, Scene


class UsageError(Exception):
    """The command line asks for something that makes no sense; exit 2."""


def fresh(path: Path, overwrite: bool) -> Path:
    """A path that may be written; FileExistsError where something stands there and -w was not given."""
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists; give -w to replace it, or another name with -o")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {path.parent} does not exist; create it first")
    return path


def open_scene(path: Path, drop_invalid: bool = False) -> tuple[Scene, list[str]]:
    """The scene of a folder, and what was dropped from it. ValueError where it is something else, or empty."""
    from scenes import Scene, load
    from scenes.files import load_dropping

    thing, dropped = load_dropping(path) if drop_invalid else (load(path), 0)
    if not isinstance(thing, Scene):
        raise ValueError(f"{path} holds {_kind(thing)}, not a scene; give a folder that sidestep recon wrote")
    if not len(thing.background.gaussians) and not thing.actors:
        raise ValueError(f"{path} is empty: it has no splats and no actors; reconstruct it again with sidestep recon")
    return thing, [f"dropped {dropped} splats with values that are not finite"] if dropped else []


def _kind(thing: Asset | Gaussians | Scene) -> str:
    return {"Asset": "an asset", "Gaussians": "splats"}[type(thing).__name__]


def warn(lines: Sequence[str]) -> None:
    for line in lines:
        print(f"sidestep: warning: {line}", file=sys.stderr)
