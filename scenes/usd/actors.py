"""A scene's actors as prims under /World/Actors: a reference to an asset each, with a path and a deformation."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import torch
from pxr import Sdf, Usd, UsdGeom

from scenes.asset import Actor
from scenes.trajectory import Trajectory
from scenes.usd.deformation import author_deformation, read_deformation
from scenes.usd.layers import author_pose, own_data, set_own_data, world_poses
from scenes.usd.splats import Clean, read_asset


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


def actor_prims(stage: Usd.Stage, edits: list[str]) -> list[Usd.Prim]:
    """The scene's own actors, then those each edit adds, the oldest first: so no insertion changes an earlier actor's instance id."""
    group = stage.GetPrimAtPath("/World/Actors")
    order = {name: i for i, name in enumerate(edits)}
    prims = [p for p in (group.GetChildren() if group else []) if defines(stage.GetLayerStack(), p)]
    return sorted(prims, key=lambda p: order.get(own_data(p).get("edit", ""), -1))


def load_actor(prim: Usd.Prim, path: Path, origin: int, clean: Clean) -> Actor:
    """The actor of a prim, with what edits made of it in its asset's meta. origin: microseconds at time code 0."""
    asset, data = read_asset(prim, path, clean), own_data(prim)
    if data.get("inserted"):
        asset = replace(asset, meta={**asset.meta, "inserted": True, "edit": data.get("edit", "")})
    if data.get("edited"):
        asset = replace(asset, meta={**asset.meta, "edited": data["edited"]})
    return Actor(asset, load_trajectory(prim, origin), data.get("track", prim.GetName()), read_deformation(prim, origin))


def load_trajectory(prim: Usd.Prim, origin: int) -> Trajectory:
    """The poses of a prim over time. origin: microseconds at time code 0."""
    codes, poses = world_poses(prim)
    return Trajectory(torch.tensor([round(c) + origin for c in codes]), poses)


def all_actor_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Every prim under /World/Actors: those too that are removed, or that only edits speak of."""
    group = stage.GetPrimAtPath("/World/Actors")
    return group.GetAllChildren() if group else []
