"""An asset of the databank becomes an actor of a scene: on the ground, in its light, facing its heading, moving as told."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from scenes.asset import Actor, Asset
from scenes.collide import collisions
from scenes.edit import named
from scenes.lane import Lane
from scenes.match import at_place, light_held, other_model
from scenes.metres import require_metres
from scenes.placement import Placement
from scenes.poses import yaw_of
from scenes.scene import Scene
from scenes.standing import outside_ground, standing_pose
from scenes.trajectory import Trajectory
from scenes.waypoints import SIDEWAYS, STEP_US, Way, ahead_and_left, sliding_warning, way_of


@dataclass(frozen=True)
class Inserted:
    """The scene with the new actor, that actor, and what the user should know about its place."""

    scene: Scene
    actor: Actor
    warnings: tuple[str, ...]


def insert(
    scene: Scene,
    asset: Asset,
    placement: Placement,
    start_us: int | None = None,
    end_us: int | None = None,
    ego: Trajectory | None = None,
) -> Inserted:
    """Put an asset into a scene.

    start_us: the time of the clip's first frame, to whose body pose the placement is relative; the drive's first by default. end_us: that
    of its last: what it runs into is looked for from the one to the other; in the whole drive by default. ego: the path that the recording
    car drives there, in whose way it may be; the recorded one by default.
    The actor gets a track of its own and `inserted` in its asset's meta; its colours are those of the light at its first place. What it
    runs into is among the warnings. ValueError where the time is off the path or the
    trajectory file is bad; where the scene is not metric.
    """
    require_metres(scene, f"the place of {placement.asset}")
    start_us = int(scene.ego.times_us[0]) if start_us is None else start_us
    if not scene.ego.covers(start_us):
        after, lasts = ((t - int(scene.ego.times_us[0])) / 1e6 for t in (start_us, int(scene.ego.times_us[-1])))
        raise ValueError(f"{placement.asset} cannot be placed {after:g}s after the drive's first moment; the drive lasts {lasts:.3g}s")
    body = scene.ego.at(start_us)
    if placement.trajectory is not None:
        way = way_of(placement.trajectory, body, start_us)
    elif placement.path == "lane":
        way = _in_lane(scene, placement, body, start_us)
    else:
        way = _straight(scene, placement, body, start_us)

    times, poses, warnings = way.times_us, [], []
    if len(times) > 1 and (times[-1] < scene.ego.times_us[0] or times[0] > scene.ego.times_us[-1]):
        first, last = ((int(t) - start_us) / 1e6 for t in (times[0], times[-1]))
        warnings.append(f"{placement.asset} is there from {first:g}s to {last:g}s only, and never during the drive")
    if placement.path == "lane" and placement.speed and abs(math.cos(placement.yaw)) < math.cos(math.radians(SIDEWAYS)):
        turned = (
            f"{placement.asset} is turned by {math.degrees(placement.yaw):g}deg from the lane that it goes along, so it slides sideways"
        )
        warnings.append(f"{turned}; give a yaw of 0deg or 180deg, or the path straight, to go where it faces")
    if placement.trajectory is not None:
        warnings += sliding_warning(placement.asset, way, placement.trajectory, start_us)
    for point, heading in zip(way.xy, way.headings, strict=True):
        poses.append(standing_pose(scene, point, float(heading), asset.size))
    beyond = max(outside_ground(scene, point) for point in way.xy)
    if scene.ground is None:
        warnings.append(f"{placement.asset}: the scene has no ground, so its height is that of the lowest splats around it")
    elif beyond > 0:
        warnings.append(f"{placement.asset} goes {beyond:.1f} m beyond the known ground and keeps the height of its edge there")
    warnings += other_model(placement.asset, asset, scene)
    path = Trajectory(times, torch.stack(poses))
    there = at_place(asset, scene, path, start_us)
    warnings += light_held(placement.asset, there, scene)
    marked = replace(there, meta={**there.meta, "inserted": True})
    actor = Actor(marked, path, _track(scene, placement.asset))
    during = None if end_us is None else (start_us, end_us)
    warnings += [f"{placement.asset} {said}" for said in collisions(scene, actor, during, ego).values()]
    return Inserted(replace(scene, actors=(*scene.actors, actor)), actor, tuple(warnings))


def _straight(scene: Scene, placement: Placement, body: torch.Tensor, start_us: int) -> Way:
    """The way of an asset that stands, or goes straight on over the whole drive."""
    heading = yaw_of(body) + placement.yaw
    origin = ahead_and_left(body, torch.tensor([[placement.x, placement.y]], dtype=torch.float64))
    if placement.speed == 0:
        return Way(torch.tensor([start_us]), origin, heading[None])
    times = _drive_times(scene)
    gone = placement.speed * (times - start_us).double() / 1e6
    xy = origin + gone[:, None] * torch.stack([torch.cos(heading), torch.sin(heading)])
    return Way(times, xy, heading.expand(len(times)))


def _in_lane(scene: Scene, placement: Placement, body: torch.Tensor, start_us: int) -> Way:
    """The way of an asset that keeps its distance to the recorded path, ahead or, turned round, against it."""
    lane = Lane(scene.ego)
    along, left = lane.of(ahead_and_left(body, torch.tensor([[placement.x, placement.y]], dtype=torch.float64))[0])
    times = _drive_times(scene) if placement.speed else torch.tensor([start_us])
    way = 1.0 if math.cos(placement.yaw) >= 0 else -1.0
    xy, headings = lane.at(lane.gone(along, left, way * placement.speed * (times - start_us).double() / 1e6), left)
    return Way(times, xy, headings + placement.yaw)


def _drive_times(scene: Scene) -> torch.Tensor:
    """Moments `[T]` over the whole drive, at most STEP_US apart."""
    first, last = int(scene.ego.times_us[0]), int(scene.ego.times_us[-1])
    count = max(2, -(-(last - first) // STEP_US) + 1)
    return torch.linspace(first, max(last, first + STEP_US), count, dtype=torch.float64).round().long()


def _track(scene: Scene, asset: str) -> str:
    """A track name that neither the scene nor an edit of it has, and that USD takes: car/0003 becomes inserted_car_0003, ..._2, ..."""
    base = "inserted_" + re.sub(r"\W", "_", asset)
    edits = scene.meta.get("edits", [])
    taken = {actor.track for actor in scene.actors} | {track for edit in edits for track in named(edit)}
    taken |= {edit["name"] for edit in edits if not edit.get("missing")}  # of `sidestep insert` the name of what it brought
    if "path" in scene.meta:  # a kill may leave the layer of an edit that the scene does not list yet
        taken |= {layer.stem for layer in Path(scene.meta["path"], "edits").glob("*.usda")}
    number = 1
    while (name := base if number == 1 else f"{base}_{number}") in taken:
        number += 1
    return name
