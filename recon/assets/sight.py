"""How the cameras of a scene saw a box: from where, from how near, and which of its sides nothing hid."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch

from render import render_frame
from scenes.camera import Camera
from scenes.poses import inverse
from scenes.scene import Scene
from scenes.seen import SECTORS, sector
from scenes.trajectory import Trajectory

FARTHEST = 20.0
"""Metres between body and object at the nearest: from farther off too little of it was seen to be looked at closely."""

NEAREST = 0.5
"""Metres of the eye from the middle of a box at least: nearer, a camera is inside."""

WIDTH = 160
"""Pixels across the pictures in which is looked up what hides an object, at most."""

BEFORE = 0.3
"""Metres that something must stand before the skin of a box to hide it, so that the object itself does not."""

SHOWN, LEAST = 0.5, 0.25
"""A side that faces a camera counts as seen where nothing stands before this part of what is in the picture of it, and that is at least
this part of the whole side: beside a long one, close by, no picture holds it all."""

_WAYS = {"front": (1, 0, 0), "left": (0, 1, 0), "rear": (-1, 0, 0), "right": (0, -1, 0)}
SIDES = {name: torch.tensor(way, dtype=torch.float64) for name, way in _WAYS.items()}
"""The upright sides of a box, by the words that `SECTORS` are made of, and which way is out there."""

ALONG, UP = 6, (0.3, 0.6, 0.9)
"""Points of a side: how many along it, and at what parts of its height."""


@dataclass(frozen=True)
class Sight:
    """How an object was seen.

    views    frames of all cameras with its middle in view within `FARTHEST`, in which a side that faces them is seen; sectors: in how many
             of them it was seen from each of `SECTORS`. Seen from a corner are the two sides that meet there: where only one of them
             is, since the next parked car hides the other, the frame counts for that one
    nearest  metres to the nearest camera that has its middle in view, hidden or not
    left, right   how large its sides appeared, summed over those frames within `FARTHEST`: solid angle of what nothing hid, in parts of
             the side's area
    """

    views: int
    nearest: float
    left: float
    right: float
    sectors: dict[str, int] = field(default_factory=dict)


class Views:
    """The cameras of a scene at their moments, in small, and how far each sees; rendered when first asked for, and kept."""

    def __init__(self, scene: Scene):
        self.scene = scene
        self._seen: dict[tuple[str, int], tuple[Camera, torch.Tensor]] = {}

    def at(self, name: str, time_us: int) -> tuple[Camera, torch.Tensor]:
        """A camera as it stood, and its depth `[H, W]`, inf where nothing is."""
        if (name, time_us) not in self._seen:
            camera = self.scene.camera(name, time_us)
            width = min(WIDTH, camera.width)
            small = camera.resized(width, max(1, round(width * camera.height / camera.width)))
            depth = render_frame(self.scene, small, ("median_depth",)).median_depth
            assert depth is not None
            self._seen[name, time_us] = small, depth.cpu()
        return self._seen[name, time_us]


@torch.no_grad()
def sight_of(views: Views, box: Trajectory, size: torch.Tensor) -> Sight:
    """How a scene's cameras saw a box `[length, width, height]`."""
    middle = torch.tensor([0.0, 0.0, float(size[2]) / 2, 1.0], dtype=torch.float64)
    points, outwards = _skin(size)
    scene, count, nearest, sides, sectors = views.scene, 0, math.inf, {"left": 0.0, "right": 0.0}, dict.fromkeys(SECTORS, 0)
    for name, camera in scene.rig.items():
        times = scene.frame_times(name)
        times = times[torch.tensor([box.covers(t) and scene.ego.covers(t) for t in times.tolist()], dtype=torch.bool)]
        cam_from_box = inverse(scene.ego.at_each(times) @ camera.body_from_cam) @ box.at_each(times)
        at = (cam_from_box @ middle)[:, :3]
        there = camera.lens.valid(at) & (at.norm(dim=1) >= NEAREST)
        pixels = camera.lens.project(at)
        there &= ((pixels >= 0) & (pixels < torch.tensor([camera.width, camera.height]))).all(1)
        nearest = min(nearest, float(at[there].norm(dim=1).min())) if there.any() else nearest
        for i in (there & (at.norm(dim=1) <= FARTHEST)).nonzero()[:, 0].tolist():
            eye = inverse(cam_from_box[i])[:3, 3]
            faces = ((eye - points) * outwards).sum(-1) > 0
            inside, free = _shown(*views.at(name, int(times[i])), points @ cam_from_box[i, :3, :3].T + cam_from_box[i, :3, 3])
            held, shown = faces & inside, faces & inside & free
            part = {name: float(shown[outwards @ way > 0].double().mean()) for name, way in SIDES.items()}
            least = {name: max(LEAST, SHOWN * float(held[outwards @ way > 0].double().mean())) for name, way in SIDES.items()}
            for side, beside in (("left", float(eye[1])), ("right", -float(eye[1]))):
                sides[side] += part[side] * (beside - float(size[1]) / 2) / float(at[i].norm()) ** 3
            if seen := " ".join(name for name in sector(float(eye[0]), float(eye[1])).split() if part[name] >= least[name]):
                count += 1
                sectors[seen] += 1
    return Sight(count, nearest, sides["left"], sides["right"], sectors)


def _skin(size: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Points on a box's four upright sides `[N, 3]`, and which way is out there `[N, 3]`."""
    along = (torch.arange(ALONG, dtype=torch.float64) + 0.5) / ALONG - 0.5
    along, up = (v.flatten() for v in torch.meshgrid(along, torch.tensor(UP, dtype=torch.float64), indexing="ij"))
    points, ways = [], []
    for way in SIDES.values():
        side = torch.stack([along, along, up], 1)
        side[:, :2] = torch.where(way[:2] == 0, side[:, :2], way[:2] / 2)
        points.append(side * size)
        ways.append(way.expand_as(side))
    return torch.cat(points), torch.cat(ways)


def _shown(camera: Camera, depth: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Whether points `[N, 3]` in a camera are in its picture, and whether nothing stands before them there, `[N]` each."""
    pixels = camera.lens.project(points)
    inside = camera.lens.valid(points) & ((pixels >= 0) & (pixels < torch.tensor([camera.width, camera.height]))).all(1)
    column, row = pixels.nan_to_num(0).long().unbind(1)
    seen = depth[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
    return inside, seen > camera.lens.depth(points) - BEFORE
