"""Edits of a scene folder: layers that add actors and leave everything else as it was."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from pxr import Sdf

from scenes.asset import Actor
from scenes.atomic import atomic_file
from scenes.usd import new_stage, open_stage, own_data, valid_names
from scenes.usd_scene import author_actor, read_metadata
from scenes.usd_splats import save_asset, to_json


def add_edit(scene: str | Path, name: str, actors: Sequence[Actor], meta: dict, half: bool = False) -> None:
    """Add actors to a scene folder as the layer edits/<name>.usda; `meta` says what the edit is, as {"kind": "insert", ...}.

    Loading the scene then includes the actors, with `inserted` in their asset's meta, and lists the edit in its own. Deleting
    the layer's file undoes it. Raises FileExistsError where the edit exists, ValueError where a track does. On failure the
    scene stays as it was.
    """
    scene = Path(scene)
    origin = int(read_metadata(scene)["origin_us"])
    if not re.fullmatch(r"[A-Za-z0-9][\w-]*", name, flags=re.ASCII):
        raise ValueError(f'"{name}" cannot name an edit; use letters, digits, - and _')
    layer = scene / "edits" / f"{name}.usda"
    if layer.exists():
        raise FileExistsError(f"{scene} already has an edit {name}; choose another name")
    with open_stage(scene / "scene.usda") as stage:
        standing = {own_data(p).get("track", p.GetName()) for p in stage.GetPrimAtPath("/World/Actors").GetChildren()}
    for actor in actors:
        if actor.track in standing:
            raise ValueError(f'{scene} already has an actor "{actor.track}"; give the new one another track name')
        standing.add(actor.track)
    names = valid_names((a.track for a in actors), [p.stem for p in scene.glob("actors/*")])  # also those of deleted edits
    files = [scene / "actors" / f"{names[a.track]}.usdc" for a in actors]
    written: list[Path] = []
    try:
        for actor, file in zip(actors, files, strict=True):
            file.parent.mkdir(exist_ok=True)
            save_asset(file, actor.asset, half)
            written.append(file)
        layer.parent.mkdir(exist_ok=True)
        with new_stage(layer, "World") as edit:
            for actor in actors:
                author_actor(edit, names[actor.track], actor, f"../actors/{names[actor.track]}.usdc", origin, inserted=True, edit=name)
            for where in ("/World", "/World/Actors"):  # the scene defines these
                edit.GetRootLayer().GetPrimAtPath(where).specifier = Sdf.SpecifierOver
            edit.GetRootLayer().customLayerData = {"sidestep_edit": to_json(meta, "the edit's meta")}
        written.append(layer)
        _sublayer(scene / "scene.usda", f"./edits/{name}.usda")
    except BaseException:
        for file in written:
            file.unlink(missing_ok=True)
        raise


def _sublayer(root: Path, sub: str) -> None:
    """Make `sub` the strongest sublayer of a layer file."""
    layer = Sdf.Layer.OpenAsAnonymous(str(root))
    paths = list(layer.subLayerPaths)
    if sub not in paths:
        layer.subLayerPaths = [sub, *paths]
        with atomic_file(root) as partial:
            if not layer.Export(str(partial)):
                raise OSError(f"cannot write {root}")
