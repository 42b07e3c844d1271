"""What an inserted actor runs into: other actors, parked vehicles, and what else stands in the background."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from scenes.asset import Actor, Asset
from scenes.edit import parked
from scenes.poses import inverse
from scenes.scene import Scene
from scenes.trajectory import Trajectory

STEP_US = 100_000
"""Between the moments that are looked at."""

SLACK = 0.1
"""Metres by which boxes may overlap: annotators leave that much air."""

CLEARANCE = 0.4
"""Metres above the ground below which the background is road, kerb and their roughness; a third of what is lower than thrice as much."""

HALF = 0.9
"""Metres that the recording car is wide to either side."""

SOLID = 0.5
"""Opacity from which a splat is something to run into."""

FEWEST = 12
"""Splats that make something: floaters come alone."""


def collisions(scene: Scene, actor: Actor, during: tuple[int, int] | None = None, ego: Trajectory | None = None) -> dict[str, str]:
    """What an actor of the scene touches during the drive, or from one time of it to another, a sentence each with the first moment, by
    what that is: "actor <track>", "ego", "background"; {} where its way is free. ego: what the recording car drives, as recorded where
    None."""
    driven = ego or scene.ego
    first, last = int(scene.ego.times_us[0]), int(scene.ego.times_us[-1])
    begin, end = during or (first, last)
    times = [t for t in range(begin, end + 1, STEP_US) if actor.trajectory.covers(t)]
    hits = met(scene, actor, times)
    found = {
        f"actor {other.track}": f"runs into {other.track} ({other.asset.label}) {(hit - first) / 1e6:.1f}s after the drive's first moment"
        for other, hit in hits
    }
    hit = next((t for t in times if driven.covers(t) and _holds(actor, driven.at(t), t)), None)
    if hit is not None:
        found["ego"] = f"is where the recording car drives {(hit - first) / 1e6:.1f}s after the drive's first moment"
    still = len(actor.trajectory) == 1
    told = {hit for other, hit in hits if other.track in parked(scene)}  # of what is parked, the splats are the background's
    if (struck := into(scene, actor, times[:1] if still else times)) and struck[0] not in told:
        hit, count = struck
        when = "" if still else f" {(hit - first) / 1e6:.1f}s after the drive's first moment"
        what = f"{count} solid splats lie in its box; a parked car, a wall, a tree"
        found["background"] = f"stands in something of the background{when}: {what}"
    return found


def met(scene: Scene, actor: Actor, times: Sequence[int]) -> list[tuple[Actor, int]]:
    """Other actors of the scene, and parked vehicles, whose boxes an actor's touches at one of these times, all covered by its path, each
    with the first."""
    found = []
    for other in (*scene.actors, *_standing(scene)):
        if other.track != actor.track and _meet(actor, other):
            hit = next((t for t in times if other.trajectory.covers(t) and boxes_touch(actor, other, t)), None)
            found += [(other, hit)] if hit is not None else []
    return found


def _standing(scene: Scene) -> list[Actor]:
    """Parked vehicles, by their boxes: splats may be lacking inside, and on sides that nobody saw."""
    when, boxes = torch.tensor([int(scene.ego.times_us[0])]), parked(scene)
    of = [(p["track"], p["label"]) for p in scene.meta.get("parked", []) if p["track"] in boxes]
    return [hollow(scene, boxes[track][1], label, Trajectory(when, boxes[track][0][None]), track) for track, label in of]


def hollow(scene: Scene, size: torch.Tensor, label: str, trajectory: Trajectory, track: str = "") -> Actor:
    """An actor that is a box of a size `[3]` alone, without splats."""
    return Actor(Asset(scene.background.gaussians.select(torch.zeros(0, dtype=torch.int64)), size, label), trajectory, track)


def into(scene: Scene, actor: Actor, times: Sequence[int]) -> tuple[int, int] | None:
    """The first of these times, all covered by an actor's path, at which its box holds something solid of the background, and how many
    splats of it; None where its way is free."""
    solid = _along(scene, actor, times)
    for t in times:
        count = _inside(solid, inverse(actor.trajectory.at(t)) @ scene.background.world_from_local, actor.asset.size)
        if count >= FEWEST:
            return t, count
    return None


def _holds(actor: Actor, world_from_body: torch.Tensor, time_us: int) -> bool:
    """Whether a body's own place lies within an actor's box, or nearer to it than half a car."""
    place = (inverse(actor.trajectory.at(time_us)) @ world_from_body)[:2, 3].abs()
    return bool((place < actor.asset.size[:2] / 2 + HALF).all())


def _meet(a: Actor, b: Actor) -> bool:
    """Whether two actors' paths come near enough in space, at whatever times, for their boxes to touch."""
    room = float(a.asset.size.norm() + b.asset.size.norm())
    paths = [x.trajectory.world_from_body[:, :2, 3] for x in (a, b)]
    low, high = torch.stack([p.amin(0) for p in paths]), torch.stack([p.amax(0) for p in paths])
    return bool((low.amax(0) < high.amin(0) + room).all())


def _along(scene: Scene, actor: Actor, times: Sequence[int]) -> torch.Tensor:
    """Means `[M, 3]` of the background's solid splats within the box that holds all of an actor's boxes at these times."""
    splats, local_from_world = scene.background.gaussians, inverse(scene.background.world_from_local)
    if not times:
        return splats.means[:0]
    middles = torch.stack([(local_from_world @ actor.trajectory.at(t))[:3, 3] for t in times]).to(splats.means)
    room = float(actor.asset.size.norm())
    near = ((splats.means > middles.amin(0) - room) & (splats.means < middles.amax(0) + room)).all(1).nonzero()[:, 0]
    return splats.means[near[torch.sigmoid(splats.logit_opacities[near]) > SOLID]]


def boxes_touch(a: Actor, b: Actor, time_us: int) -> bool:
    """Whether the boxes of two actors overlap at a time, by the separating axes of their footprints (Gottschalk 1996) and their heights."""
    poses = [x.trajectory.at(time_us) for x in (a, b)]
    low, high = [], []
    for x, pose in zip((a, b), poses, strict=True):
        low.append(float(pose[2, 3]))
        high.append(float(pose[2, 3] + x.asset.size[2]) - SLACK)
    if low[0] > high[1] or low[1] > high[0]:
        return False
    corners = [_footprint(x, pose) for x, pose in zip((a, b), poses, strict=True)]
    for pose in poses:
        for axis in (pose[:2, 0], pose[:2, 1]):
            axis = axis / axis.norm()
            spans = [(float((c @ axis).min()), float((c @ axis).max())) for c in corners]
            if spans[0][0] + SLACK > spans[1][1] or spans[1][0] + SLACK > spans[0][1]:
                return False
    return True


def _footprint(actor: Actor, pose: torch.Tensor) -> torch.Tensor:
    length, width, _ = (actor.asset.size / 2).tolist()
    corners = torch.tensor([[length, width, 0], [length, -width, 0], [-length, width, 0], [-length, -width, 0]], dtype=torch.float64)
    return (corners @ pose[:3, :3].T + pose[:3, 3])[:, :2]


def _inside(means: torch.Tensor, box_from_local: torch.Tensor, size: torch.Tensor) -> int:
    """How many of the points `[N, 3]` lie in a box, but for its rim and the clearance above the ground."""
    pose = box_from_local.to(means.dtype)
    at = means @ pose[:3, :3].T + pose[:3, 3]
    half, low = size[:2].to(means.dtype) / 2 - SLACK, min(CLEARANCE, float(size[2]) / 3)
    return int(((at[:, :2].abs() < half).all(1) & (at[:, 2] > low) & (at[:, 2] < float(size[2]) - SLACK)).sum())
