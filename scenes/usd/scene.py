"""A scene as a folder that opens in usdview.

scene.usda        the order in which the layers below count, nothing else (scenes/usd/root.py)
recorded.usda     Z up, metres, one time code a microsecond counted from the first body pose; lays out /World
background.usdc   the background's splats, a payload of /World/Background
actors/*.usdc     one asset each, referenced by /World/Actors/<track>, whose translate and orient samples are its trajectory, and
                  which carries its deformation, if it has one (scenes/usd/deformation.py)
edits/*.usda      sublayers that add, change and remove actors without touching the rest (scenes/usd/edit.py)
ground.usdc       the height field as a mesh, referenced by /World/Ground; a guide: not rendered
sky_linear.hdr    the texture of /World/Lights/Sky
photos/           what the scene was made from, where it was kept (render/album.py)
metadata.json     what USD cannot carry exactly: lenses, image sizes, exposures, capture times, the splat model, metadata

/World/Ego carries the body's trajectory and its cameras, fixed to it. Every fact stands in one place only.
"""

from __future__ import annotations

from pathlib import Path

from pxr import Gf, Usd, UsdGeom, UsdLux

from scenes.atomic import atomic_folder
from scenes.edit import unparked
from scenes.gaussians import Gaussians, Placed, SplatModel
from scenes.hdr import load_hdr, save_hdr
from scenes.scene import Scene
from scenes.sky import Sky
from scenes.usd.actors import actor_prims, author_actor, load_actor, load_trajectory
from scenes.usd.camera import author_camera, load_camera
from scenes.usd.edit_layers import check_edits, read_edits
from scenes.usd.ground import load_ground, save_ground
from scenes.usd.layers import author_pose, local_pose, new_stage, open_stage, valid_names
from scenes.usd.metadata import check_parked, is_scene, metadata_text, read_metadata
from scenes.usd.root import RECORDED, write_root
from scenes.usd.splats import Clean, only_splats, read_splats, save_asset, save_gaussians

_SKY_TURN = Gf.Quatf(0.5, 0.5, 0.5, 0.5)  # a latlong texture has +y up and +z in its centre: z -> x, x -> y, y -> z


def save_scene(path: Path, scene: Scene, replace: bool = False, half: bool = False) -> None:
    """Write a scene folder, whole or not at all. An existing target is refused, or with `replace` must be a scene."""
    if path.exists() and not is_scene(path):
        raise FileExistsError(f"{path} exists and is not a Sidestep scene, so it is left alone; choose another name")
    if path.exists() and not replace:
        raise FileExistsError(f"{path} exists; pass overwrite=True (-w) to replace it")
    origin = int(scene.ego.times_us[0])
    cameras, tracks = valid_names(scene.rig), valid_names(a.track for a in scene.actors)
    with atomic_folder(path, replace) as folder:
        save_gaussians(folder / "background.usdc", scene.background.gaussians, scene.model, half)
        (folder / "actors").mkdir()
        (folder / "edits").mkdir()
        for actor in scene.actors:
            save_asset(folder / "actors" / f"{tracks[actor.track]}.usdc", actor.asset, half)
        if scene.ground is not None:
            save_ground(folder / "ground.usdc", scene.ground)
        if scene.sky is not None:
            save_hdr(folder / "sky_linear.hdr", scene.sky.linear)
        (folder / "metadata.json").write_text(metadata_text(scene, cameras, origin), encoding="utf-8")
        with new_stage(folder / "recorded.usda", "World") as stage:
            _author_world(stage, scene, cameras, tracks, origin)
        write_root(folder)


def load_scene(path: Path, clean: Clean = Gaussians.checked) -> Scene:
    """The scene of a folder, with its edits: inserted actors have `inserted` and `edit` in their asset's meta, changed ones `edited`.

    An edit whose layer was deleted is undone; ValueError where one is damaged, or its layer lacks a file.
    """
    meta = read_metadata(path)
    with open_stage(path / "scene.usda") as stage:
        if RECORDED in list(stage.GetRootLayer().subLayerPaths) and not (path / RECORDED).is_file():
            raise FileNotFoundError(f"{path} lacks what was recorded: {path / RECORDED} is missing")
        check_edits(stage, path)
        return _read_scene(stage, path, meta, clean)


def load_recorded(path: Path, clean: Clean = Gaussians.checked) -> Scene:
    """The scene of a folder as it was reconstructed, without its edits."""
    meta = read_metadata(path)
    file = path / RECORDED if (path / RECORDED).is_file() else path / "scene.usda"  # a scene of before has no edits yet
    with open_stage(file) as stage:
        return _read_scene(stage, path, meta, clean)


def _read_scene(stage: Usd.Stage, path: Path, meta: dict, clean: Clean) -> Scene:
    try:
        origin, model = int(meta["origin_us"]), SplatModel(**meta["model"])
        rig = {name: load_camera(stage, entry, name) for name, entry in meta["cameras"].items()}
        own_meta = dict(meta["meta"])
        check_parked(own_meta.get("parked", []), path / "metadata.json")
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path / 'metadata.json'} is corrupt: {type(error).__name__} {error}") from error
    background = _prim(stage, "/World/Background", path)
    splats = clean(read_splats(only_splats(background, path)), f"{path}, background")
    edits = read_edits(stage)
    if edits:
        own_meta["edits"] = edits
        own_meta = unparked(own_meta, [track for edit in edits for track in edit.get("remove", ())])
    return Scene(
        Placed(splats, local_pose(background)),
        tuple(load_actor(p, path, origin, clean) for p in actor_prims(stage, [e["name"] for e in edits])),
        _load_sky(stage, path),
        load_trajectory(_prim(stage, "/World/Ego", path), origin),
        rig,
        model,
        load_ground(stage, path),
        own_meta,
    )


def _author_world(stage: Usd.Stage, scene: Scene, cameras: dict[str, str], tracks: dict[str, str], origin: int) -> None:
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(int(scene.ego.times_us[-1]) - origin)
    UsdGeom.Xform.Define(stage, "/World")
    background = UsdGeom.Xform.Define(stage, "/World/Background").GetPrim()
    background.GetPayloads().AddPayload("./background.usdc")
    author_pose(background, scene.background.world_from_local)
    UsdGeom.Scope.Define(stage, "/World/Actors")
    for actor in scene.actors:
        author_actor(stage, tracks[actor.track], actor, f"./actors/{tracks[actor.track]}.usdc", origin)
    ego = UsdGeom.Xform.Define(stage, "/World/Ego").GetPrim()
    author_pose(ego, scene.ego.world_from_body, (scene.ego.times_us - origin).tolist())
    for name, camera in scene.rig.items():
        author_camera(stage, f"/World/Ego/{cameras[name]}", camera)
    if scene.ground is not None:
        UsdGeom.Mesh.Define(stage, "/World/Ground").GetPrim().GetReferences().AddReference("./ground.usdc")
    if scene.sky is not None:
        UsdGeom.Scope.Define(stage, "/World/Lights")
        dome = UsdLux.DomeLight.Define(stage, "/World/Lights/Sky")
        dome.CreateTextureFileAttr("./sky_linear.hdr")
        dome.CreateTextureFormatAttr("latlong")
        UsdGeom.Xformable(dome).AddOrientOp().Set(_SKY_TURN)


def _load_sky(stage: Usd.Stage, path: Path) -> Sky | None:
    dome = UsdLux.DomeLight(stage.GetPrimAtPath("/World/Lights/Sky"))
    if not dome:
        return None
    texture = dome.GetTextureFileAttr().Get()
    file = Path(texture.resolvedPath) if texture and texture.resolvedPath else path / (texture.path if texture else "sky_linear.hdr")
    if not file.is_file():
        raise FileNotFoundError(f"{path} lacks its sky: {file} is missing")
    return Sky(load_hdr(file))


def _prim(stage: Usd.Stage, where: str, path: Path) -> Usd.Prim:
    prim = stage.GetPrimAtPath(where)
    if not prim:
        raise ValueError(f"{path / 'scene.usda'} has no {where}")
    return prim
