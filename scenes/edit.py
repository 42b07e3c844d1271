"""What an edit does to a scene: actors are removed, shifted, replaced, retimed. In memory; scenes/usd/edit.py keeps it as a layer."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace

import torch

from scenes.asset import Actor, Asset
from scenes.detail import finest_pixel
from scenes.gaussians import Gaussians
from scenes.match import at_place
from scenes.metres import require_metres
from scenes.names import unknown
from scenes.poses import inverse
from scenes.scene import Scene
from scenes.standing import moved, stood
from scenes.trajectory import Trajectory

HIDDEN = -15.0
"""Logit opacity of splats that an edit hides: the least that a scene's files hold, far below what is drawn."""

GHOST_FLOOR = 0.2
"""Metres above the base of an actor's box under which splats are street."""

GHOST_MARGIN = 0.1
"""Metres around an actor's box within which the fit left traces of it."""

PARKED_FLOOR, PARKED_MARGIN = 0.08, 0.25
"""The same of parked vehicles, which are splats of the background: they stand on the street, and lidar boxes cut them close."""

NEARER = 0.8
"""Part of a pixel's former width at which it is told that an actor has come too near for the detail that is left of it."""

BELOW = 0.6
"""Metres below the base of a parked vehicle's box down to which splats are the street that it stands on."""

RIM, AROUND = 0.4, 2.5
"""Metres from a box between which the street beside it shows how it looks below."""

BESIDE = 16
"""Splats of the street beside a box, the nearest, whose mean colour one below it gets."""


@dataclass(frozen=True)
class Edit:
    """Changes of actors by track name: tracks to remove; metres forward and left along the actor's own body; another asset on
    the same path; microseconds by which everything happens later. originals: of actors that were put in from a databank, and are shifted or
    retimed, the assets as it holds them, of which a scene keeps no more detail than could be seen where it put them."""

    remove: tuple[str, ...] = ()
    shift: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    replace: Mapping[str, Asset] = field(default_factory=dict)
    retime: Mapping[str, int] = field(default_factory=dict)
    originals: Mapping[str, Asset] = field(default_factory=dict)

    def tracks(self) -> list[str]:
        """Every track that it changes, once."""
        return list(dict.fromkeys([*self.remove, *self.shift, *self.replace, *self.retime]))

    def places(self, actor: Actor) -> bool:
        """Whether it puts an asset in a new place, where it gets that place's light and detail: one that replaces the actor, or, where the
        actor was put in itself, its own."""
        return actor.track in self.replace or not actor.recorded and actor.track in {*self.shift, *self.retime}

    def path(self, actor: Actor, scene: Scene) -> Trajectory:
        """The actor's path as it is changed, with its wheels on the scene's ground as they were, another asset's right on it."""
        path = actor.trajectory
        if actor.track in self.shift:
            path = moved(path, self.shift[actor.track], actor.asset.size, scene)
        if actor.track in self.retime:
            path = replace(path, times_us=path.times_us + self.retime[actor.track])
        return stood(path, self.replace[actor.track].size, scene) if actor.track in self.replace else path

    def apply(self, actor: Actor, scene: Scene) -> Actor:
        """The actor as it is changed, with `edited` in its asset's meta; an asset that it `places` as it looks where it is at the drive's
        first moment, or nearest to that."""
        path, deformation = self.path(actor, scene), actor.deformation
        if actor.track in self.replace:
            asset, deformation = self.replace[actor.track], None  # another body bends elsewhere
        else:
            asset, deformation = self._own(actor), deformation and deformation.later(self.retime.get(actor.track, 0))
        if self.places(actor):
            asset = at_place(asset, scene, path, int(scene.ego.times_us[0]))
        return replace(actor, asset=replace(asset, meta={**asset.meta, "edited": True}), trajectory=path, deformation=deformation)

    def _own(self, actor: Actor) -> Asset:
        """An actor's asset, with all the detail that is known of it."""
        original = self.originals.get(actor.track)
        if original is None:
            return actor.asset
        return replace(original, meta={**original.meta, **{k: v for k, v in actor.asset.meta.items() if k in ("inserted", "edit")}})


def named(entry: Mapping) -> list[str]:
    """The tracks that an edit changes, of its entry in a scene's `meta["edits"]` as `sidestep edit` writes it; of others none."""
    return [track for key in ("remove", "shift_m", "replace", "retime_us") for track in entry.get(key, ())]


def check_edit(edit: Edit, scene: Scene) -> None:
    """ValueError where the edit names a track that the scene has not, contradicts itself, or would change nothing, and where it
    shifts by metres what has none."""
    for track in edit.shift:
        require_metres(scene, f"the shift of {track}")
    have, standing = {a.track: a for a in scene.actors}, parked(scene)
    for track in edit.tracks():
        if track not in have and track not in standing:
            where, names = str(scene.meta.get("path", scene.meta.get("name", "the scene"))), [*have, *standing]
            if by := next((e["name"] for e in scene.meta.get("edits", []) if track in e.get("remove", ())), None):
                raise ValueError(f"{track} is not in {where} any more: the edit {by} removed it; --undo {by} brings it back")
            option = next(key for key in ("remove", "shift", "replace", "retime") if track in getattr(edit, key))
            each = f"--{option} {{}}" + ("" if option == "remove" else "=...")
            raise ValueError(unknown("actor", track, where, names, each))
        if track not in have and track not in edit.remove:
            raise ValueError(f"{track} is parked, and part of the background: it can be removed, and another asset inserted in its place")
        if track in edit.remove and (track in edit.shift or track in edit.replace or track in edit.retime):
            raise ValueError(f"{track} cannot be both removed and changed by one edit; give one of the two")
        if edit.shift.get(track) == (0, 0) or edit.retime.get(track) == 0:
            raise ValueError(f"{track} is shifted or retimed by zero, which changes nothing; say by how much, as 0m,1.5m or +0.5s")
        if track in edit.retime and len(have[track].trajectory) == 1:
            raise ValueError(f"{track} stands still for all times, so it cannot be retimed; shift or remove it")


def coarse(edit: Edit, scene: Scene, databank: str) -> list[str]:
    """What to tell of actors that were put in from a databank, and that an edit brings nearer than they were without their `originals`:
    a sentence each."""
    said = []
    for actor in (a for a in scene.actors if edit.places(a) and a.track not in {*edit.replace, *edit.originals}):
        if finest_pixel(scene, edit.path(actor, scene)) < NEARER * finest_pixel(scene, actor.trajectory):
            what = f"the asset {actor.asset.meta['id']}" if "id" in actor.asset.meta else "what it is a copy of"
            lacks = f"{actor.track} comes nearer, but {databank} does not hold {what}, so it shows no more detail than from where it was"
            said.append(f"{lacks}; name the databank that does with --databank")
    return said


def absences(edit: Edit, scene: Scene) -> list[str]:
    """What to tell of actors that an edit takes, by their new times, out of a part of the drive: a sentence each."""
    first, last = (int(t) for t in scene.ego.times_us[[0, -1]])
    said = []
    for actor in (a for a in scene.actors if a.track in edit.retime):
        was, now = actor.trajectory.span_us(), edit.path(actor, scene).span_us()
        if now[0] > max(first, was[0]) or now[1] < min(last, was[1]):
            begin, end = ((t - first) / 1e6 for t in now)
            said.append(
                f"{actor.track} is now there from {begin:.1f}s to {end:.1f}s only, of a drive of {(last - first) / 1e6:.1f}s"
                + (": never" if now[0] > last or now[1] < first else "; where it was before or after that nobody recorded")
            )
    return said


def edited(scene: Scene, edit: Edit) -> Scene:
    """The scene after an edit. Traces that the background holds of the actors where they were, and parked vehicles, are hidden, and the
    street below those looks as beside them."""
    check_edit(edit, scene)
    tracks = edit.tracks()
    actors = tuple(edit.apply(a, scene) if a.track in tracks else a for a in scene.actors if a.track not in edit.remove)
    splats = scene.background.gaussians
    logits = torch.where(ghosts(scene, tracks), splats.logit_opacities.new_tensor(HIDDEN), splats.logit_opacities)
    sh = splats.sh.clone()
    painted, colours = bared(scene, edit.remove)
    sh[painted] = colours
    hidden = replace(scene.background, gaussians=replace(splats, logit_opacities=logits, sh=sh))
    return replace(scene, actors=actors, background=hidden, meta=unparked(scene.meta, edit.remove))


def unparked(meta: Mapping, tracks: Collection[str]) -> dict:
    """A scene's meta with the entries of these `parked` vehicles among `parked_once`: they are gone, but what shadows the street has beside
    them still tells of the sun (scenes/light.py)."""
    gone = [p for p in meta.get("parked", []) if p["track"] in tracks]
    if not gone:
        return dict(meta)
    left = [p for p in meta["parked"] if p["track"] not in tracks]
    return {**meta, "parked": left, "parked_once": [*meta.get("parked_once", []), *gone]}


def parked(scene: Scene) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Parked vehicles that the background holds, by track: pose `[4, 4]` and size `[3]` of their boxes."""
    entries = [p for p in scene.meta.get("parked", []) if max(p["size"]) > 0]
    as_tensor = lambda rows: torch.tensor(rows, dtype=torch.float64)  # noqa: E731
    return {p["track"]: (as_tensor(p["world_from_box"]), as_tensor(p["size"])) for p in entries}


def ghosts(scene: Scene, tracks: Iterable[str]) -> torch.Tensor:
    """Mask `[N]` of background splats inside a box that these actors moved through, or in which these vehicles are parked.

    Nothing else can have stood where an actor went: a fit paints into the background what the actor's box did not quite explain of it,
    and that is seen once the actor has gone. An inserted actor went nowhere, and of one that was edited before, the edit hid what was
    to hide: their boxes may well hold what is real.
    """
    splats, world_from_local = scene.background.gaussians, scene.background.world_from_local
    found, standing = torch.zeros(len(splats), dtype=torch.bool), parked(scene)
    tracks = set(tracks)
    for actor in (a for a in scene.actors if a.track in tracks and not a.anew):
        for pose in _dense(actor.trajectory, float(actor.asset.size[0]) / 2):
            _mark(found, splats, inverse(pose) @ world_from_local, actor.asset.size, GHOST_FLOOR, GHOST_MARGIN)
    for pose, size in (box for track, box in standing.items() if track in tracks):
        _mark(found, splats, inverse(pose) @ world_from_local, size, PARKED_FLOOR, PARKED_MARGIN)
    return found


def bared(scene: Scene, tracks: Iterable[str]) -> tuple[torch.Tensor, torch.Tensor]:
    """Indices `[M]` of background splats that are the street below these parked vehicles, and their harmonics `[M, K, 3]` as it looks
    beside them.

    No photo shows that street, and the fit paints on it what it could not explain by the vehicle: tyres, doors, its shadow. How it looks
    is taken from the side that the recorded path passed: what lies behind a parked vehicle was hidden, too.
    """
    splats, world_from_local, boxes = scene.background.gaussians, scene.background.world_from_local, parked(scene)
    seen = torch.sigmoid(splats.logit_opacities) > 0.5
    for pose, size in boxes.values():
        seen &= ~_below(splats, inverse(pose) @ world_from_local, size, RIM)
    path = inverse(world_from_local) @ scene.ego.world_from_body
    indices, colours = [torch.zeros(0, dtype=torch.long)], [splats.sh[:0]]
    for pose, size in (boxes[track] for track in tracks if track in boxes):
        box_from_local = inverse(pose) @ world_from_local
        below = _below(splats, box_from_local, size, PARKED_MARGIN).nonzero()[:, 0]
        beside = (_below(splats, box_from_local, size, AROUND) & seen).nonzero()[:, 0]
        middle = inverse(box_from_local)[:3, 3].float()
        passed = path[(path[:, :3, 3].float() - middle).norm(dim=1).argmin(), :3, 3].float()
        beside = beside[(splats.means[beside] - passed).norm(dim=1) < (middle - passed).norm()]
        if len(beside) and len(below):
            nearest = torch.cdist(splats.means[below], splats.means[beside]).topk(min(BESIDE, len(beside)), largest=False).indices
            sh = torch.zeros_like(splats.sh[below])
            sh[:, 0] = splats.sh[beside, 0][nearest].mean(1)
            indices.append(below)
            colours.append(sh)
    return torch.cat(indices), torch.cat(colours)


def _below(splats: Gaussians, box_from_local: torch.Tensor, size: torch.Tensor, margin: float) -> torch.Tensor:
    """Mask `[N]` of splats below a box grown by `margin` metres: the street."""
    at = splats.means @ box_from_local[:3, :3].T.float() + box_from_local[:3, 3].float()
    return (at[:, :2].abs() <= size[:2].float() / 2 + margin).all(1) & (at[:, 2] <= PARKED_FLOOR) & (at[:, 2] > -BELOW)


def _mark(found: torch.Tensor, splats: Gaussians, box_from_local: torch.Tensor, size: torch.Tensor, floor: float, margin: float) -> None:
    """Set `found` `[N]` where a splat stands in a box grown by `margin` metres, above its base by `floor`."""
    centre = inverse(box_from_local)[:3, 3].float()
    near = ((splats.means - centre).abs().amax(1) < float(size.norm()) + margin).nonzero()[:, 0]
    at = splats.means[near] @ box_from_local[:3, :3].T.float() + box_from_local[:3, 3].float()
    half = size[:2].float() / 2 + margin
    found[near] |= (at[:, :2].abs() <= half).all(1) & (at[:, 2] > floor) & (at[:, 2] < float(size[2]) + margin)


def _dense(path: Trajectory, step: float) -> torch.Tensor:
    """Poses `[T, 4, 4]` of a path no further apart than `step` metres, as far as one between each two can do."""
    poses = path.world_from_body
    if len(path) == 1 or float(poses[:, :3, 3].diff(dim=0).norm(dim=1).max()) <= step:
        return poses
    middles = (path.times_us[:-1] + path.times_us[1:]) // 2
    return torch.cat([poses, torch.stack([path.at(int(t)) for t in middles])])
