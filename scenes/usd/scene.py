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

import json
from collections.abc import Iterable
from dataclasses import asdict, fields, replace
from pathlib import Path
from shlex import quote

import numpy as np
import torch
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdLux, Vt

from scenes.asset import Actor
from scenes.atomic import atomic_folder
from scenes.camera import RigCamera
from scenes.edit import unparked
from scenes.gaussians import Gaussians, Placed, SplatModel
from scenes.ground import Ground
from scenes.hdr import load_hdr, save_hdr
from scenes.lenses import LENSES, Orthographic
from scenes.names import absent
from scenes.scene import Scene
from scenes.sky import Sky
from scenes.trajectory import Trajectory
from scenes.usd.deformation import author_deformation, read_deformation
from scenes.usd.layers import array, author_pose, local_pose, new_stage, open_stage, own_data, set_own_data, valid_names, world_poses
from scenes.usd.root import RECORDED, write_root
from scenes.usd.splats import Clean, only_splats, read_asset, read_splats, save_asset, save_gaussians, to_json

FORMAT = "sidestep scene"
VERSION = 1
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # USD cameras look along -z with y up
_SKY_TURN = Gf.Quatf(0.5, 0.5, 0.5, 0.5)  # a latlong texture has +y up and +z in its centre: z -> x, x -> y, y -> z
_APERTURE = 0.20955  # of a 20.955 mm wide film, in USD's tenths of a scene unit: only its ratio to the focal length counts


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
            _save_ground(folder / "ground.usdc", scene.ground)
        if scene.sky is not None:
            save_hdr(folder / "sky_linear.hdr", scene.sky.linear)
        (folder / "metadata.json").write_text(_metadata(scene, cameras, origin), encoding="utf-8")
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
        _check_edits(stage, path)
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
        rig = {name: _load_camera(stage, entry, name) for name, entry in meta["cameras"].items()}
        own_meta = dict(meta["meta"])
        _check_parked(own_meta.get("parked", []), path / "metadata.json")
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
        tuple(_load_actor(p, path, origin, clean) for p in _actor_prims(stage, [e["name"] for e in edits])),
        _load_sky(stage, path),
        _trajectory(_prim(stage, "/World/Ego", path), origin),
        rig,
        model,
        _load_ground(stage, path),
        own_meta,
    )


def _check_parked(entries: list[dict], file: Path) -> None:
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


def read_edits(stage: Usd.Stage) -> list[dict]:
    """Name and metadata of the edit layers that a scene's stage has, the oldest first; `missing` where the file is gone."""
    root, out = stage.GetRootLayer(), []
    for sub in (s for s in reversed(list(root.subLayerPaths)) if s != RECORDED):
        layer = Sdf.Layer.Find(root.ComputeAbsolutePath(sub))
        data = dict(layer.customLayerData) if layer else {}
        told = json.loads(data.get("sidestep_edit", "{}")) if layer else {"missing": True}
        out.append({**told, "name": Path(sub).stem})
    return out


def _check_edits(stage: Usd.Stage, path: Path) -> None:
    """ValueError where an edit's layer is there, and it or a file that it refers to is missing, damaged, or ends with its header."""
    root = stage.GetRootLayer()
    for sub in (s for s in root.subLayerPaths if s != RECORDED and (path / s).exists()):
        layer = Sdf.Layer.Find(root.ComputeAbsolutePath(sub))
        below = layer.GetCompositionAssetDependencies() if layer else ()
        for file in (f for f in (path / sub, *(path / "edits" / s for s in below)) if not _says_something(f)):
            how, name = "damaged" if file.exists() else "missing", Path(sub).stem
            fix = f"restore it, or undo the edit: sidestep edit {quote(str(path))} --undo {name}"
            raise ValueError(f"{file} is {how}, so the edit {name} cannot be applied; {fix}")


def _says_something(file: Path) -> bool:
    """Whether a layer is there, can be read, and has a prim."""
    try:
        layer = Sdf.Layer.FindOrOpen(str(file))
    except Tf.ErrorException:
        return False
    return bool(layer and layer.rootPrims)


def defines(layers: Iterable[Sdf.Layer], prim: Usd.Prim) -> bool:
    """Whether one of these layers defines a prim itself: what an edit gives another asset still seems defined once its actor is gone."""
    specs = (layer.GetPrimAtPath(prim.GetPath()) for layer in layers)
    return any(spec and spec.specifier == Sdf.SpecifierDef for spec in specs)


def author_actor(stage: Usd.Stage, name: str, actor: Actor, asset_file: str, origin: int, **data) -> None:
    """Define /World/Actors/<name>: a reference to an asset file, moving along the actor's trajectory while it covers the time, and
    deforming as it does."""
    prim = UsdGeom.Xform.Define(stage, f"/World/Actors/{name}").GetPrim()
    prim.GetReferences().AddReference(asset_file)
    set_own_data(prim, track=actor.track, **data)
    author_path(prim, actor.trajectory, origin)
    if actor.deformation is not None:
        author_deformation(prim, actor.deformation, origin)


def author_path(prim: Usd.Prim, path: Trajectory, origin: int) -> None:
    """Give a prim the poses of a trajectory, and let it be seen only while that covers the time."""
    author_pose(prim, path.world_from_body, (path.times_us - origin).tolist())
    if len(path) > 1:
        first, last = (t - origin for t in path.span_us())
        visibility = prim.CreateAttribute("visibility", Sdf.ValueTypeNames.Token, False)
        for time, token in ((first - 1, "invisible"), (first, "inherited"), (last + 1, "invisible")):
            visibility.Set(token, time)


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
        _author_camera(stage, f"/World/Ego/{cameras[name]}", camera)
    if scene.ground is not None:
        UsdGeom.Mesh.Define(stage, "/World/Ground").GetPrim().GetReferences().AddReference("./ground.usdc")
    if scene.sky is not None:
        UsdGeom.Scope.Define(stage, "/World/Lights")
        dome = UsdLux.DomeLight.Define(stage, "/World/Lights/Sky")
        dome.CreateTextureFileAttr("./sky_linear.hdr")
        dome.CreateTextureFormatAttr("latlong")
        UsdGeom.Xformable(dome).AddOrientOp().Set(_SKY_TURN)


def _author_camera(stage: Usd.Stage, where: str, camera: RigCamera) -> None:
    """A USD camera that sees what the lens would see without distortion: film offsets point to where the image centre looks."""
    usd = UsdGeom.Camera.Define(stage, where)
    (fx, fy), cx, cy = camera.lens.focal(), float(camera.lens.cx), float(camera.lens.cy)
    parallel = isinstance(camera.lens, Orthographic)
    wide = 10 * camera.width / fx if parallel else _APERTURE  # a parallel view's film is as wide as what it sees, in tenths again
    focal = _APERTURE * fx / camera.width
    tall = wide * fx / camera.width * camera.height / fy
    if parallel:
        usd.CreateProjectionAttr("orthographic")
    else:
        usd.CreateFocalLengthAttr(focal)
    usd.CreateHorizontalApertureAttr(wide)
    usd.CreateVerticalApertureAttr(tall)
    usd.CreateHorizontalApertureOffsetAttr((camera.width / 2 - cx) / camera.width * wide)
    usd.CreateVerticalApertureOffsetAttr((cy - camera.height / 2) / camera.height * tall)
    usd.CreateClippingRangeAttr(Gf.Vec2f(0.05, 100_000.0))
    author_pose(usd.GetPrim(), camera.body_from_cam @ _FLIP)


def _load_camera(stage: Usd.Stage, entry: dict, name: str) -> RigCamera:
    prim = stage.GetPrimAtPath(f"/World/Ego/{entry['prim']}")
    if not prim:
        raise ValueError(f"camera {name} is in metadata.json but /World/Ego/{entry['prim']} is not in scene.usda")
    lens = dict(entry["lens"])
    kind = lens.pop("type")
    if kind not in LENSES:
        raise ValueError(f"camera {name} has a {kind} lens; this Sidestep knows {', '.join(LENSES)}")
    exposure = torch.tensor(entry["exposure"], dtype=torch.float32)
    times = torch.tensor(entry["times_us"], dtype=torch.int64)
    shutter = entry.get("shutter", "global"), entry.get("readout_us", 0)  # absent from scenes of before
    gains = None if entry.get("gains") is None else torch.tensor(entry["gains"], dtype=torch.float32)
    return RigCamera(LENSES[kind](**lens), entry["width"], entry["height"], local_pose(prim) @ _FLIP, exposure, times, *shutter, gains)


def _metadata(scene: Scene, cameras: dict[str, str], origin: int) -> str:
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
        }
        for name, c in scene.rig.items()
    }
    meta = {k: v for k, v in scene.meta.items() if k != "edits"}  # edits become part of what is written
    model = asdict(scene.model)
    whole = {"format": FORMAT, "version": VERSION, "origin_us": origin, "model": model, "cameras": table, "meta": meta}
    return to_json(whole, "the scene's meta")


def _actor_prims(stage: Usd.Stage, edits: list[str]) -> list[Usd.Prim]:
    """The scene's own actors, then those each edit adds, the oldest first: so no insertion changes an earlier actor's instance id."""
    group = stage.GetPrimAtPath("/World/Actors")
    order = {name: i for i, name in enumerate(edits)}
    prims = [p for p in (group.GetChildren() if group else []) if defines(stage.GetLayerStack(), p)]
    return sorted(prims, key=lambda p: order.get(own_data(p).get("edit", ""), -1))


def _load_actor(prim: Usd.Prim, path: Path, origin: int, clean: Clean) -> Actor:
    asset, data = read_asset(prim, path, clean), own_data(prim)
    if data.get("inserted"):
        asset = replace(asset, meta={**asset.meta, "inserted": True, "edit": data.get("edit", "")})
    if data.get("edited"):
        asset = replace(asset, meta={**asset.meta, "edited": data["edited"]})
    return Actor(asset, _trajectory(prim, origin), data.get("track", prim.GetName()), read_deformation(prim, origin))


def _trajectory(prim: Usd.Prim, origin: int) -> Trajectory:
    codes, poses = world_poses(prim)
    return Trajectory(torch.tensor([round(c) + origin for c in codes]), poses)


def _load_sky(stage: Usd.Stage, path: Path) -> Sky | None:
    dome = UsdLux.DomeLight(stage.GetPrimAtPath("/World/Lights/Sky"))
    if not dome:
        return None
    texture = dome.GetTextureFileAttr().Get()
    file = Path(texture.resolvedPath) if texture and texture.resolvedPath else path / (texture.path if texture else "sky_linear.hdr")
    if not file.is_file():
        raise FileNotFoundError(f"{path} lacks its sky: {file} is missing")
    return Sky(load_hdr(file))


def _save_ground(path: Path, ground: Ground) -> None:
    ny, nx = ground.heights.shape
    heights = ground.heights.detach().cpu().numpy()
    y, x = np.meshgrid(np.arange(ny), np.arange(nx), indexing="ij")
    points = np.stack([ground.origin[0] + x * ground.cell, ground.origin[1] + y * ground.cell, heights], -1)
    corner = (y * nx + x)[:-1, :-1].reshape(-1, 1)
    faces = corner + np.array([0, 1, nx + 1, nx])
    with new_stage(path, "Ground") as stage:
        mesh = UsdGeom.Mesh.Define(stage, "/Ground")
        points = points.reshape(-1, 3).astype(np.float32)
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 4, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1).astype(np.int32)))
        mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
        mesh.CreateSubdivisionSchemeAttr("none")
        mesh.CreateDoubleSidedAttr(True)
        mesh.CreatePurposeAttr("guide")
        grid = {"origin": Vt.DoubleArray([float(v) for v in ground.origin]), "cell": float(ground.cell), "rows": ny, "columns": nx}
        set_own_data(mesh.GetPrim(), **grid)


def _load_ground(stage: Usd.Stage, path: Path) -> Ground | None:
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Ground"))
    if not mesh:
        return None
    data, points = own_data(mesh.GetPrim()), array(mesh.GetPointsAttr(), 3)
    if points is None:
        raise FileNotFoundError(f"{path} lacks its ground: {path / 'ground.usdc'} is missing")
    try:
        heights = points[:, 2].reshape(data["rows"], data["columns"])
        return Ground(torch.from_numpy(heights.copy()), tuple(data["origin"]), data["cell"])
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path / 'ground.usdc'} is not a height field: {error}") from error


def _prim(stage: Usd.Stage, where: str, path: Path) -> Usd.Prim:
    prim = stage.GetPrimAtPath(where)
    if not prim:
        raise ValueError(f"{path / 'scene.usda'} has no {where}")
    return prim
