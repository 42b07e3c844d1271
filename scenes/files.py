"""Scenes, assets and splats on disk: one `load` and one `save` for all kinds of path."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from scenes.asset import Asset
from scenes.databank import Databank
from scenes.formats import SUFFIXES, USD, found, named
from scenes.gaussians import Gaussians, SplatModel
from scenes.names import absent
from scenes.scene import Scene

KINDS = ("scene", "databank", "asset", "splats")


def load(path: str | os.PathLike) -> Scene | Asset | Gaussians:
    """What a path holds: a Scene (folder), an Asset (USD, or its folder in a databank) or Gaussians (any of scenes.formats).

    Raises FileNotFoundError where the path or a file that it needs is missing; ValueError where it is none of these, is
    corrupt or cut short, or holds a value that is not finite, naming splat and field. Nothing is loaded in part.
    """
    return read(path, Gaussians.checked)


def load_dropping(path: str | os.PathLike) -> tuple[Scene | Asset | Gaussians, int]:
    """As `load`, but leaves out splats whose values are not finite or not a rotation, and says how many those were."""
    clean = Dropping()
    return read(path, clean), clean.count


def save(
    thing: Scene | Asset | Gaussians,
    path: str | os.PathLike,
    overwrite: bool = False,
    half: bool = False,
    model: SplatModel | None = None,
) -> None:
    """Write a Scene as a folder, an Asset as .usdc or .usda, Gaussians as the suffix says (scenes.formats): whole or not at all.

    model: what Gaussians were trained with, where that is known; USD keeps it, and PLY, SPZ and SOG whether it is antialiased.
    `half` stores all but positions in USD's half precision, at about half the bytes. An existing target raises
    FileExistsError; with `overwrite` a file is replaced, a folder only if it is a scene. Raises ValueError where a value is
    not finite or the suffix does not fit.
    """
    path = Path(path)
    if isinstance(thing, Scene):
        from scenes.usd.scene import save_scene

        for name, gaussians in splats_of(thing):
            gaussians.validate(name)
        for actor in thing.actors:
            if actor.deformation is not None:
                actor.deformation.validate(f"actor {actor.track}")
        save_scene(path, thing, overwrite, half)
        return
    form = named(path)
    if form is None or (isinstance(thing, Asset) and form is not USD):
        what, suffixes = ("an asset", USD.suffixes) if isinstance(thing, Asset) else ("splats", SUFFIXES)
        raise ValueError(f'{path} has the suffix "{path.suffix}"; {what} can be written as {", ".join(suffixes)}')
    if path.is_dir() or (path.exists() and not overwrite):
        raise FileExistsError(f"{path} exists" + ("" if path.is_dir() else "; pass overwrite=True (-w) to replace it"))
    for name, gaussians in splats_of(thing):
        gaussians.validate(name)
    if isinstance(thing, Asset):
        from scenes.usd.splats import save_asset

        save_asset(path, thing, half)
    elif form is USD:
        from scenes.usd.splats import save_gaussians

        save_gaussians(path, thing, model, half)
    else:
        form.save(path, thing, bool(model and model.antialias))


def kind_of(path: str | os.PathLike) -> str:
    """Which of KINDS a path is, by its name and what lies in it. FileNotFoundError or ValueError where it is none."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(absent(path))
    if path.is_dir():
        for name, kind in (("scene.usda", "scene"), ("metadata.json", "scene"), ("index.json", "databank"), ("asset.usdc", "asset")):
            if (path / name).exists():
                return kind
    elif path.name == "scene.usda":
        return "scene"
    form = found(path)
    if form is USD:
        from scenes.usd.layers import open_stage, own_data

        with open_stage(path) as stage:
            root = stage.GetDefaultPrim()
            return "asset" if root and own_data(root).get("kind") == "asset" else "splats"
    if form is not None:
        return "splats"
    if path.is_dir():
        raise ValueError(f"{path} is neither a scene (scene.usda), a databank (index.json) nor SOG splats (meta.json)")
    raise ValueError(f"{path} is not a kind of file that Sidestep knows: a scene or databank folder, {', '.join(SUFFIXES)}")


class Dropping:
    """Leaves out splats whose values are not finite or not a rotation, and counts them."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, gaussians: Gaussians, where: str) -> Gaussians:
        bad = gaussians.invalid()
        self.count += int(bad.sum())
        return gaussians.select(~bad)


def as_is(gaussians: Gaussians, where: str) -> Gaussians:
    """The splats of a file with whatever values they have."""
    return gaussians


def read(path: str | os.PathLike, clean: Callable[[Gaussians, str], Gaussians] = as_is) -> Scene | Asset | Gaussians:
    """As `load`, with `clean(gaussians, where)` to answer for the values of each set of splats."""
    path = Path(path)
    kind = kind_of(path)
    if kind == "databank":
        ids = [e.id for e in Databank(path).entries()]
        raise ValueError(f"{path} is a databank; load one of its assets: {', '.join(ids[:6]) or 'it has none'}")
    if kind == "splats" and (form := found(path)):
        return form.load(path, clean)
    if kind == "scene":
        from scenes.usd.scene import load_scene

        return load_scene(path if path.is_dir() else path.parent, clean)
    from scenes.usd.splats import load_asset

    return load_asset(path / "asset.usdc" if path.is_dir() else path, clean)


def splats_of(thing: Scene | Asset | Gaussians) -> list[tuple[str, Gaussians]]:
    """All splats of a thing, each with a name for messages."""
    if isinstance(thing, Scene):
        return [("background", thing.background.gaussians), *((f"actor {a.track}", a.asset.gaussians) for a in thing.actors)]
    return [(f"asset {thing.label}", thing.gaussians)] if isinstance(thing, Asset) else [("splats", thing)]
