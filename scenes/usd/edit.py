"""Edits of a scene folder: layers that add, change and remove actors, and leave the files of everything else as they were.

edits/<name>.usda is the edit; edits/<name>/ holds the splats that it brings, and says which ones of the background it hides. Deleting
the layer undoes it; `undo` tidies up too.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from pxr import Sdf, Usd, UsdVol, Vt

from scenes.alone import alone
from scenes.asset import Actor
from scenes.atomic import atomic_file, atomic_folder, need_folder
from scenes.deformation import Deformation
from scenes.edit import Edit, bared, check_edit, ghosts
from scenes.names import unknown
from scenes.scene import Scene
from scenes.usd.deformation import author_weights
from scenes.usd.layers import new_stage, open_stage, own_data, set_own_data, valid_names
from scenes.usd.root import RECORDED, add_sublayer, drop_sublayer
from scenes.usd.scene import author_actor, author_path, defines, load_recorded, read_edits, read_metadata
from scenes.usd.splats import only_splats, save_asset, to_json

BUILDERS = {
    Sdf.ValueTypeNames.FloatArray: Vt.FloatArrayEditBuilder,
    Sdf.ValueTypeNames.HalfArray: Vt.HalfArrayEditBuilder,
    Sdf.ValueTypeNames.Float3Array: Vt.Vec3fArrayEditBuilder,
    Sdf.ValueTypeNames.Half3Array: Vt.Vec3hArrayEditBuilder,
}
"""What edits an array of a type."""

ASIDE = ".undone."
"""How a folder's name begins in which the files of edits lie that are being undone."""


def add_edit(scene: str | Path, name: str, actors: Sequence[Actor], meta: dict) -> None:
    """Add actors to a scene folder as the layer edits/<name>.usda; `meta` says what the edit is, as {"kind": "insert", ...}.

    Loading the scene then includes the actors, with `inserted` in their asset's meta, and lists the edit in its own. Deleting
    the layer's file undoes it. Raises FileExistsError where the edit exists, ValueError where a track does. On failure the
    scene stays as it was.
    """
    with alone(scene):
        _add(Path(scene), name, actors, meta)


def _add(scene: Path, name: str, actors: Sequence[Actor], meta: dict) -> None:
    origin = int(read_metadata(scene)["origin_us"])
    _sweep(scene)
    standing, taken = _prims(scene)
    for actor in actors:
        if actor.track in standing:
            raise ValueError(f'{scene} already has an actor "{actor.track}"; give the new one another track name')
        standing[actor.track] = ""
    names = valid_names((a.track for a in actors), taken)

    def files(folder: Path) -> None:
        for actor in actors:
            save_asset(folder / f"{names[actor.track]}.usdc", actor.asset)

    def author(layer: Usd.Stage) -> None:
        for actor in actors:
            author_actor(layer, names[actor.track], actor, f"./{name}/{names[actor.track]}.usdc", origin, inserted=True, edit=name)
        for where in ("/World", "/World/Actors"):  # the recorded layer defines these
            layer.GetRootLayer().GetPrimAtPath(where).specifier = Sdf.SpecifierOver

    _write(scene, name, meta, files, author)


def add_change(path: str | Path, name: str, scene: Scene, edit: Edit, meta: dict) -> None:
    """Keep an edit of the actors of `scene`, as loaded from the folder `path`, as the layer edits/<name>.usda.

    A removed actor becomes inactive, and the splats of a removed parked vehicle transparent, the street below it
    as beside it; another one's path is outweighed, and its asset where the edit `places` one;
    `edited` in their asset's meta names the edit, and `remove` in its own meta who is gone.
    An edit stands on what it found: of two that change the same actor, the later one counts.
    Raises as `add_edit` and `check_edit`.
    """
    with alone(path):
        _change(Path(path), name, scene, edit, meta)


def _change(path: Path, name: str, scene: Scene, edit: Edit, meta: dict) -> None:
    check_edit(edit, scene)
    origin, (prims, _) = int(read_metadata(path)["origin_us"]), _prims(path)
    changed = [edit.apply(a, scene) for a in scene.actors if a.track in edit.tracks() and a.track not in edit.remove]
    # of what was recorded, whatever other edits say: any of them may be undone
    recorded = load_recorded(path)
    hidden = ghosts(recorded, edit.tracks()).nonzero()[:, 0].tolist()
    painted, colours = bared(recorded, edit.remove)

    def files(folder: Path) -> None:
        for actor in filter(edit.places, changed):
            save_asset(folder / f"{Path(prims[actor.track]).name}.usdc", actor.asset)
        if hidden or len(painted):
            _save_background(path, folder / "hidden.usda", hidden, painted.tolist(), colours.tolist())

    def author(layer: Usd.Stage) -> None:
        layer.OverridePrim("/World")
        for track in (t for t in edit.remove if t in prims):  # what is parked is among the hidden splats
            layer.OverridePrim(prims[track]).SetActive(False)
        for actor in changed:
            prim = layer.OverridePrim(prims[actor.track])
            set_own_data(prim, edited=name)
            author_path(prim, actor.trajectory, origin)
            if edit.places(actor):
                prim.GetReferences().SetReferences([Sdf.Reference(f"./{name}/{prim.GetName()}.usdc")])
            elif (deformation := _in_step(actor, recorded)) is not None:
                author_weights(prim, deformation, origin)
        if hidden or len(painted):
            layer.GetRootLayer().subLayerPaths = [f"./{name}/hidden.usda"]

    _write(path, name, {**meta, "remove": list(edit.remove)} if edit.remove else meta, files, author)


def _in_step(actor: Actor, recorded: Scene) -> Deformation | None:
    """How an actor deforms along its path as an edit leaves it, None where it does not: of one that was recorded, and that another edit may
    have replaced, as it would were it put back."""
    was = next((a for a in recorded.actors if a.track == actor.track), actor)
    return was.deformation and was.deformation.later(int(actor.trajectory.times_us[0] - was.trajectory.times_us[0]))


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
    edit, and where an edit changes such an actor and something else.
    """
    scene = Path(scene)
    read_metadata(scene)
    with alone(scene):
        root, out = scene / "scene.usda", list[Undone]()
        before = root.read_bytes()
        need_folder(root)
        _sweep(scene)
        with TemporaryDirectory(prefix=ASIDE, dir=scene) as aside:
            try:
                gone: set[str] = set()
                for name in names:
                    if name not in gone:
                        out.append(_taken_out(scene, name, Path(aside)))
                        gone |= {name, *out[-1].idle}
                yield [replace(u, held={edit: tracks for edit, tracks in u.held.items() if edit not in gone}) for u in out]
            except BaseException:
                for path in Path(aside).iterdir():
                    path.rename(scene / "edits" / path.name)
                with atomic_file(root) as partial:
                    partial.write_bytes(before)
                raise


def _taken_out(scene: Path, name: str, aside: Path) -> Undone:
    """Move an edit's files, and those of the edits that go with it, from a scene to the folder `aside`."""
    edits = scene / "edits"
    with open_stage(scene / "scene.usda") as stage:
        have = [e["name"] for e in read_edits(stage)]
        if name not in have and not (_is_name(name) and ((edits / f"{name}.usda").exists() or (edits / name).exists())):
            raise ValueError(unknown("edit", name, str(scene), have, "--undo {}"))
        gone = Undone(name, tuple(_idle_without(stage, name)), _held(stage, name))
    for each in (*gone.idle, name):
        drop_sublayer(scene, f"./edits/{each}.usda")
        for path in (p for p in (edits / f"{each}.usda", edits / each) if p.exists()):
            need_folder(path)
            path.rename(aside / path.name)
    return gone


def _sweep(scene: Path) -> None:
    """Take away what an undoing that was killed had put aside: whatever the scene shows by then, it shows without these files."""
    for aside in scene.glob(f"{ASIDE}*"):
        shutil.rmtree(aside, ignore_errors=True)


def free_name(scene: Path, wish: str) -> str:
    """The wish, or the wish and a number, that names no edit yet."""
    taken = {p.stem for p in (scene / "edits").glob("*")}
    number = 2
    while (name := wish if wish not in taken else f"{wish}_{number}") in taken:
        number += 1
    return name


def _is_name(name: str) -> bool:
    return re.fullmatch(r"[A-Za-z0-9][\w-]*", name, flags=re.ASCII) is not None


def _idle_without(stage: Usd.Stage, name: str) -> list[str]:
    """Edits that change nothing but actors which the edit `name` alone defines, or defined before its layer was deleted."""
    root, out = stage.GetRootLayer(), []
    layers = {Path(sub).stem: Sdf.Layer.Find(root.ComputeAbsolutePath(sub)) for sub in root.subLayerPaths if sub != RECORDED}
    own = layers.pop(name, None)
    rest = [layer for layer in stage.GetLayerStack() if layer != own]
    gone = {p.GetName() for p in _children(stage) if not defines(rest, p) and (own is None or defines([own], p))}
    for edit, layer in layers.items():
        actors = layer and layer.GetPrimAtPath("/World/Actors")
        changed = set(actors.nameChildren.keys()) if actors else set()
        if changed & gone and (changed - gone or layer.subLayerPaths):
            lost = ", ".join(sorted(changed & gone))
            raise ValueError(f"the edit {edit} changes more than {lost}, which {name} brought; undo both: --undo {edit} --undo {name}")
        if changed & gone:
            out.append(edit)
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


def _children(stage: Usd.Stage) -> list[Usd.Prim]:
    """Every prim under /World/Actors: those too that are removed, or that only edits speak of."""
    group = stage.GetPrimAtPath("/World/Actors")
    return group.GetAllChildren() if group else []


def _prims(scene: Path) -> tuple[dict[str, str], list[str]]:
    """Prim path of every actor of a scene folder, removed ones too, by track; and the names that prims have there."""
    with open_stage(scene / "scene.usda") as stage:
        prims, layers = _children(stage), stage.GetLayerStack()
        paths = {own_data(p).get("track", p.GetName()): str(p.GetPath()) for p in prims if defines(layers, p)}
        return paths, [p.GetName() for p in prims]


def _write(scene: Path, name: str, meta: dict, files: Callable[[Path], None], author: Callable[[Usd.Stage], None]) -> None:
    """The files of an edit, its layer, and last its place in the scene: all or nothing."""
    if not _is_name(name):
        raise ValueError(f'"{name}" cannot name an edit; use letters, digits, - and _')
    layer, folder = scene / "edits" / f"{name}.usda", scene / "edits" / name
    if layer.exists():
        raise FileExistsError(f"{scene} already has an edit {name}; choose another name")
    layer.parent.mkdir(exist_ok=True)
    try:
        with atomic_folder(folder, replace=True) as partial:  # what stands there is left of an edit whose layer was deleted
            files(partial)
        if not any(folder.iterdir()):
            folder.rmdir()
        with new_stage(layer, "World") as stage:
            author(stage)
            stage.GetRootLayer().customLayerData = {"sidestep_edit": to_json(meta, "the edit's meta")}
        add_sublayer(scene, f"./edits/{name}.usda")
    except BaseException:
        layer.unlink(missing_ok=True)
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _save_background(scene: Path, file: Path, hidden: Iterable[int], painted: Iterable[int], colours: Iterable[list]) -> None:
    """A layer that edits the background, and says no word of the rest, so that each edit changes its own: opacities, 0 of the `hidden`
    splats, and harmonics `[K, 3]` each of the `painted`."""
    harmonics = [(splat * len(sh) + k, tuple(c)) for splat, sh in zip(painted, colours, strict=True) for k, c in enumerate(sh)]
    with open_stage(scene / "scene.usda") as stage:
        splats = UsdVol.ParticleField3DGaussianSplat(only_splats(stage.GetPrimAtPath("/World/Background"), scene))
        where = splats.GetPath()
        changes: list[tuple[str, Sdf.ValueTypeName, list]] = [
            (*_array(splats.GetOpacitiesAttr(), splats.GetOpacitieshAttr()), [(splat, 0.0) for splat in hidden]),
            (*_array(
                splats.GetRadianceSphericalHarmonicsCoefficientsAttr(), splats.GetRadianceSphericalHarmonicsCoefficientshAttr()
            ), harmonics),
        ]  # fmt: skip
    with new_stage(file, "World") as layer:
        layer.OverridePrim("/World")
        prim = layer.OverridePrim(where)
        for name, kind, values in changes:
            builder = BUILDERS[kind]()
            for at, value in values:
                builder.Write(value, at)
            if values:
                prim.CreateAttribute(name, kind, False).Set(builder.FinalizeAndReset())


def _array(full: Usd.Attribute, half: Usd.Attribute) -> tuple[str, Sdf.ValueTypeName]:
    """Name and type of which of two attributes holds an array: full or half precision."""
    attribute = full if full.HasAuthoredValue() else half
    return attribute.GetName(), attribute.GetTypeName()
