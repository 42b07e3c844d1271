"""Removes what hangs before things that move, where no lidar looked through: from the recorded path splats on the line of sight to a car
look just as it does, and are a ghost from beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from recon.fit.model import Splats
from recon.ground import above_ground
from recon.log import Track
from recon.objects.actors import CORNERS
from scenes.camera import Camera
from scenes.ground import Ground
from scenes.poses import inverse

FAR = 30.0
"""Metres up to which it is asked what is before a box."""

AHEAD = 0.5, 0.05
"""Metres, and parts of its distance, by which something must be nearer than a box to hang before it."""

ABOVE = 0.3
"""Metres above the ground from which on something hangs."""

PART = 0.3
"""Part of the pictures that show it, each by how large it is there, in which it hangs before a box: what stands there is seen before other
things, too."""


@dataclass(frozen=True)
class Veiled:
    """A picture's camera, and of boxes that it shows the rectangles `[B, 4]` in its pixels, left, top, right and bottom, and how near
    `[B]` they are, in metres."""

    camera: Camera
    rectangles: torch.Tensor
    near: torch.Tensor


@dataclass(frozen=True)
class Veils:
    """Pictures of what moves over a ground."""

    pictures: Sequence[Veiled]
    ground: Ground

    @staticmethod
    def of(cameras: Sequence[Camera], tracks: Sequence[Track], ground: Ground) -> Veils:
        """Of pictures' cameras, and what moves."""
        pictures = [_veiled(camera, [t for t in tracks if t.moving]) for camera in cameras]
        return Veils(pictures if any(len(p.near) for p in pictures) else [], ground)

    def holds(self, splats: Splats) -> torch.Tensor:
        """Mask `[N]` of the splats of the background that hang before boxes."""
        mask, means = torch.zeros_like(splats.reach, dtype=torch.bool), splats.fields["means"][: splats.sizes[0]].detach()
        if not self.pictures:
            return mask
        high = torch.from_numpy(above_ground(means.double().cpu().numpy(), self.ground) > ABOVE).to(means.device).nonzero()[:, 0]
        points = means[high]
        shown, before = torch.zeros(2, len(points), device=points.device)
        for picture in self.pictures:
            camera, back = picture.camera, inverse(picture.camera.world_from_cam).to(points)
            local = points @ back[:3, :3].T + back[:3, 3]
            asked = ((local[:, 2] > 0) & (local[:, 2] < 2 * FAR)).nonzero()[:, 0]  # from farther off it is hardly seen
            (x, y), z = camera.lens.project(local[asked]).unbind(1), local[asked, 2]
            inside = (x > 0) & (y > 0) & (x < camera.width) & (y < camera.height)
            veils = torch.zeros_like(inside)
            for (left, top, right, bottom), away in zip(picture.rectangles.tolist(), picture.near.tolist(), strict=True):
                veils |= (x > left) & (x < right) & (y > top) & (y < bottom) & (z < away - AHEAD[0] - AHEAD[1] * away)
            large = inside / z.clamp_min(AHEAD[0]).square()
            shown[asked] += large
            before[asked] += large * veils
        mask[high] = before > PART * shown
        return mask


def _veiled(camera: Camera, tracks: Sequence[Track]) -> Veiled:
    rectangles, near = [], []
    back = inverse(camera.world_from_cam)
    for track in tracks:
        path = track.trajectory()
        if not path.covers(camera.time_us):
            continue
        pose = (back @ path.at(camera.time_us)).numpy()
        corners = torch.from_numpy(CORNERS * track.size @ pose[:3, :3].T + pose[:3, 3])
        if 0 < corners[:, 2].min() < FAR:
            pixels = camera.lens.project(corners)
            rectangles.append(torch.cat([pixels.amin(0), pixels.amax(0)]))
            near.append(float(corners[:, 2].min()))
    return Veiled(camera, torch.stack(rectangles) if rectangles else torch.zeros(0, 4), torch.tensor(near))
