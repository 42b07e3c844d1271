"""Edits of a scene folder: layers that add, change and remove actors, and leave the files of everything else as they were.

edits/<name>.usda is the edit; edits/<name>/ holds the splats that it brings, and says which ones of the background it hides. Deleting
the layer undoes it; scenes/usd/undo.py also deletes its files.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from pxr import Sdf, Usd, UsdVol, Vt

from scenes.alone import alone
from scenes.asset import Actor
from scenes.atomic import atomic_folder, made_folder
from scenes.deformation import Deformation
from scenes.edit import Edit, bared, check_edit, ghosts
from scenes.scene import Scene
from scenes.usd.actors import all_actor_prims, author_actor, author_path, defines
from scenes.usd.deformation import author_weights
from scenes.usd.edit_layers import is_edit_name
from scenes.usd.layers import new_stage, open_stage, own_data, set_own_data, valid_names
from scenes.usd.metadata import read_metadata
from scenes.usd.root import add_sublayer
from scenes.usd.scene import load_recorded
from scenes.usd.splats import only_splats, save_asset, to_json
from scenes.usd.undo import clear_aside

BUILDERS = {
    Sdf.ValueTypeNames.FloatArray: Vt.FloatArrayEditBuilder,
    Sdf.ValueTypeNames.HalfArray: Vt.HalfArrayEditBuilder,
    Sdf.ValueTypeNames.Float3Array: Vt.Vec3fArrayEditBuilder,
    Sdf.ValueTypeNames.Half3Array: Vt.Vec3hArrayEditBuilder,
}
"""What edits an array of a type."""


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
    clear_aside(scene)
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


def free_name(scene: Path, wish: str) -> str:
    """The wish, or the wish and a number, that names no edit yet."""
    taken = {p.stem for p in (scene / "edits").glob("*")}
    number = 2
    while (name := wish if wish not in taken else f"{wish}_{number}") in taken:
        number += 1
    return name


def _prims(scene: Path) -> tuple[dict[str, str], list[str]]:
    """Prim path of every actor of a scene folder, removed ones too, by track; and the names that prims have there."""
    with open_stage(scene / "scene.usda") as stage:
        prims, layers = all_actor_prims(stage), stage.GetLayerStack()
        paths = {own_data(p).get("track", p.GetName()): str(p.GetPath()) for p in prims if defines(layers, p)}
        return paths, [p.GetName() for p in prims]


def _write(scene: Path, name: str, meta: dict, files: Callable[[Path], None], author: Callable[[Usd.Stage], None]) -> None:
    """The files of an edit, its layer, and last its place in the scene: all or nothing."""
    if not is_edit_name(name):
        raise ValueError(f'"{name}" cannot name an edit; use letters, digits, - and _')
    layer, folder = scene / "edits" / f"{name}.usda", scene / "edits" / name
    if layer.exists():
        raise FileExistsError(f"{scene} already has an edit {name}; choose another name")
    made_folder(layer.parent)
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
