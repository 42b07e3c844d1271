"""Takes edits out of a scene folder, with all their files, and those edits that cannot stand without them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from pxr import Sdf, Usd

from scenes.alone import alone
from scenes.atomic import atomic_file, need_folder
from scenes.names import unknown
from scenes.usd.actors import all_actor_prims, defines
from scenes.usd.edit_layers import is_edit_name, read_edits
from scenes.usd.layers import open_stage, own_data
from scenes.usd.metadata import read_metadata
from scenes.usd.root import RECORDED, drop_sublayer

ASIDE = ".undone."
"""How a folder's name begins in which the files of edits lie that are being undone."""


@dataclass(frozen=True)
class Undone:
    """An edit that was taken out of a scene folder."""

    name: str
    idle: tuple[str, ...]
    """Edits that changed only actors which it brought, and went with it."""
    held: dict[str, list[str]]
    """Later edits that moved an actor from where this one had put it, and still do, as what it made of it; and which actors."""


def undo(scene: str | Path, name: str) -> list[str]:
    """Take one edit out of a scene folder, as `undone` does; returns the names of those that went with it."""
    with undone(scene, [name]) as (gone,):
        return list(gone.idle)


@contextmanager
def undone(scene: str | Path, names: Sequence[str]) -> Iterator[list[Undone]]:
    """Take edits out of a scene folder, with all their files, for a block that changes it further; where that fails they are back.

    Also one whose layer was deleted by hand. With each go the edits that changed only actors which it brought. ValueError for no such
    edit, and where an edit that stays changes such an actor and something else.
    """
    scene = Path(scene)
    read_metadata(scene)
    with alone(scene):
        root, out = scene / "scene.usda", list[Undone]()
        before = root.read_bytes()
        need_folder(root)
        clear_aside(scene)
        with TemporaryDirectory(prefix=ASIDE, dir=scene) as aside:
            try:
                gone: set[str] = set()
                for name in names:
                    if name not in gone:
                        out.append(_taken_out(scene, name, Path(aside), names))
                        gone |= {name, *out[-1].idle}
                yield [replace(u, held={edit: tracks for edit, tracks in u.held.items() if edit not in gone}) for u in out]
            except BaseException:
                for path in Path(aside).iterdir():
                    path.rename(scene / "edits" / path.name)
                with atomic_file(root) as partial:
                    partial.write_bytes(before)
                raise


def _taken_out(scene: Path, name: str, aside: Path, leaving: Sequence[str]) -> Undone:
    """Move an edit's files, and those of the edits that go with it, from a scene to the folder `aside`; `leaving` are all that will go."""
    edits = scene / "edits"
    with open_stage(scene / "scene.usda") as stage:
        have = [e["name"] for e in read_edits(stage)]
        if name not in have and not (is_edit_name(name) and ((edits / f"{name}.usda").exists() or (edits / name).exists())):
            raise ValueError(unknown("edit", name, str(scene), have, "--undo {}"))
        gone = Undone(name, tuple(_idle_without(stage, name, leaving)), _held(stage, name))
    for each in (*gone.idle, name):
        drop_sublayer(scene, f"./edits/{each}.usda")
        for path in (p for p in (edits / f"{each}.usda", edits / each) if p.exists()):
            need_folder(path)
            path.rename(aside / path.name)
    return gone


def clear_aside(scene: Path) -> None:
    """Take away what an undoing that was killed had put aside: whatever the scene shows by then, it shows without these files."""
    for aside in scene.glob(f"{ASIDE}*"):
        shutil.rmtree(aside, ignore_errors=True)


def _idle_without(stage: Usd.Stage, name: str, leaving: Sequence[str]) -> list[str]:
    """Edits that change nothing but actors which the edit `name` alone defines, or defined before its layer was deleted. ValueError where
    one changes more, but for those that are `leaving` by themselves."""
    root, out = stage.GetRootLayer(), []
    layers = {Path(sub).stem: Sdf.Layer.Find(root.ComputeAbsolutePath(sub)) for sub in root.subLayerPaths if sub != RECORDED}
    own = layers.pop(name, None)
    rest = [layer for layer in stage.GetLayerStack() if layer != own]
    gone = {p.GetName() for p in all_actor_prims(stage) if not defines(rest, p) and (own is None or defines([own], p))}
    for edit, layer in layers.items():
        actors = layer and layer.GetPrimAtPath("/World/Actors")
        changed = set(actors.nameChildren.keys()) if actors else set()
        if not changed & gone:
            continue
        if not changed - gone and not layer.subLayerPaths:
            out.append(edit)
        elif edit not in leaving:
            lost = ", ".join(sorted(changed & gone))
            raise ValueError(f"the edit {edit} changes more than {lost}, which {name} brought; undo both: --undo {edit} --undo {name}")
    return out


def _held(stage: Usd.Stage, name: str) -> dict[str, list[str]]:
    """Tracks of the actors whose path the edit `name` tells and a later one tells anew, from there on; by the later edit's name."""
    root = stage.GetRootLayer()
    paths = {}  # the newest first, as the layers are
    for sub in (s for s in root.subLayerPaths if s != RECORDED):
        layer = Sdf.Layer.Find(root.ComputeAbsolutePath(sub))
        actors = layer and layer.GetPrimAtPath("/World/Actors")
        paths[Path(sub).stem] = {p.name for p in actors.nameChildren if "xformOp:translate" in p.attributes} if actors else set()
    own, out = paths.get(name, set()), {}
    for edit in list(paths)[: list(paths).index(name)] if name in paths else []:
        if both := sorted(own & paths[edit]):
            out[edit] = [own_data(stage.GetPrimAtPath(f"/World/Actors/{prim}")).get("track", prim) for prim in both]
    return out
