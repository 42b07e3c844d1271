"""Which cameras see an actor, and whether they see it from where no photo of it was ever taken."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch

from scenes.asset import Actor, Asset
from scenes.camera import Camera
from scenes.poses import inverse

SECTORS = ("front", "front left", "left", "rear left", "rear", "rear right", "right", "front right")
"""Eighths of the turn about an object, counted to the left from its nose."""

NEAR = 0.1
"""Metres of depth within which a camera sees nothing."""

FEW = 5
"""Pictures from the next sector that show enough of a side that none was taken of."""


def seeing(actor: Actor, cameras: Sequence[Camera]) -> list[Camera]:
    """The cameras into whose image a corner or the middle of the actor's box falls, hidden or not."""
    length, width, height = (float(v) for v in actor.asset.size)
    corners = [[a * length / 2, b * width / 2, c * height] for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (0, 0.5, 1)]
    box, found = torch.tensor(corners, dtype=torch.float64), []
    for camera in cameras:
        if actor.trajectory.covers(camera.time_us):
            cam_from_asset = inverse(camera.world_from_cam) @ actor.trajectory.at(camera.time_us)
            points = box @ cam_from_asset[:3, :3].T + cam_from_asset[:3, 3]
            pixels = camera.lens.project(points[camera.lens.valid(points) & (camera.lens.depth(points) > NEAR)])
            size = torch.tensor([camera.width, camera.height])
            if ((pixels >= 0) & (pixels <= size)).all(1).any():
                found.append(camera)
    return found


def absence_warning(actor: Actor, cameras: Sequence[Camera], witnesses: Sequence[Camera]) -> list[str]:
    """What to tell of an actor that a clip's cameras never see, or that comes or goes before their eyes since its path begins or ends: a
    sentence, or nothing. witnesses: those of them that see it."""
    there = [actor.trajectory.covers(camera.time_us) for camera in cameras]
    id = actor.asset.meta.get("id", actor.track)
    seconds = [(t - cameras[0].time_us) / 1e6 for t in (*actor.trajectory.times_us[[0, -1]].tolist(), cameras[-1].time_us)]
    said = f"is there from {seconds[0]:g}s to {seconds[1]:g}s after the clip's first frame, and the clip lasts {seconds[2]:g}s"
    if not any(there):
        return [f"{id} {said}: none of its frames shows it"]
    if not witnesses:
        return [f"{id} is never in view: X is metres forward, Y metres to the left"]
    sees = [any(camera is witness for witness in witnesses) for camera in cameras]
    before_eyes = any(a != b and (s or t) for a, b, s, t in zip(there, there[1:], sees, sees[1:], strict=False))
    return [f"{id} {said}: it appears or disappears in view; let its trajectory begin earlier or end later"] if before_eyes else []


def sector(ahead: float, beside: float) -> str:
    """The sector in which a point forward and left of an object lies."""
    return SECTORS[round(math.atan2(beside, ahead) / (2 * math.pi) * len(SECTORS)) % len(SECTORS)]


def unseen_sides(asset: Asset) -> list[str]:
    """The sectors from which an asset's look is a guess: no picture was taken there, and fewer than `FEW` on either side of it.

    `meta["sectors"]` counts pictures, and a mirrored asset's count on both sides. Of assets that do not say (a mesh has all sides) none.
    """
    counts = asset.meta.get("sectors")
    if not counts:
        return []
    taken = [int(counts.get(name, 0)) for name in SECTORS]
    if asset.meta.get("mirrored"):
        taken = [max(taken[i], taken[-i]) for i in range(len(SECTORS))]
    return [name for i, name in enumerate(SECTORS) if not taken[i] and max(taken[i - 1], taken[(i + 1) % len(SECTORS)]) < FEW]


def unseen_warning(actor: Actor, cameras: Iterable[Camera]) -> list[str]:
    """What to tell of an actor whose `unseen_sides` are shown by cameras, at their own moments, that see it: a sentence, or nothing."""
    missing = unseen_sides(actor.asset)
    eyes = [inverse(actor.trajectory.at(c.time_us)) @ c.world_from_cam[:, 3] for c in cameras] if missing else []
    shown = {sector(float(eye[0]), float(eye[1])) for eye in eyes}
    named = [name for name in missing if name in shown]
    if not named:
        return []
    id = actor.asset.meta.get("id", actor.track)
    said = f"{id} is shown from its {_listed(named)}, from where no photo of it was taken: what stands there is a guess; "
    # what an edit put in another's place goes as that one did
    turn = "" if actor.asset.meta.get("edited") else "turn it (its yaw by 180deg), or "
    return [f"{said}{turn}take another one (sidestep assets show {id} says from where it was seen)"]


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
