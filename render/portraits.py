"""What the photos that an asset was cut out of know of it, wherever it is put: detail that its splats blur, moved along with it.

As for the photos of a drive (`render/references.py`), it is the difference to the splats that is moved, here to the asset's own, in the
light in which it is shown: colours of the photo are first brought to theirs in the mean, and what changes slowly is taken away, so that
neither exposure nor the light of the street where it was taken goes along. What was mirrored or closed by guess has no photo and stays as
it is.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Collection

import torch
import warp as wp
from torch.nn import functional as F

from render.frame_types import Frame
from render.kernels.detail import add_photo
from render.rasterize import rasterize
from render.seen import GONE, NOISE, PARALLAX, Part, Seen, faded, run_over
from scenes.asset import Actor, AssetPhoto
from scenes.camera import Camera
from scenes.gaussians import Placed, SplatModel
from scenes.poses import inverse
from scenes.scene import Scene

NEAR = 0.1
"""Radians between two directions, seen from the asset, that are near."""

BRIGHTER = 4.0
"""Times that a photo is made brighter or darker at most to be as bright as the splats."""

FEWEST = 50
"""Pixels of an asset in a photo that tell its colours."""

SLOW = 0.25
"""Part of a photo's longer side over which the mean difference is light, not detail: that of the street where it was taken."""

KEPT = 8
"""Photos whose difference is kept for the next frames."""


class Portraits:
    """The photos of an actor's asset, for the frames that show it as `instance`; `model_for` gives the model of a camera's pictures of
    their scene."""

    def __init__(self, actor: Actor, instance: int, model_for: Callable[[Camera], SplatModel]):
        self.asset, self.instance, self.model_for = actor.asset, instance, model_for
        self.photos = actor.asset.photos
        self.centre = torch.tensor([0.0, 0.0, float(actor.asset.size[2]) / 2], dtype=torch.float64)
        self.eyes = torch.stack([p.camera.world_from_cam[:3, 3] for p in self.photos]) - self.centre
        self.pixels = torch.tensor([_pixels_a_metre(p, eye) for p, eye in zip(self.photos, self.eyes, strict=True)], dtype=torch.float64)
        self.kept: OrderedDict[tuple[int, int], Seen] = OrderedDict()

    def add(
        self, frame: Frame, placed: list[Placed], clear: torch.Tensor, rays: torch.Tensor, sums: torch.Tensor, squares: torch.Tensor,
        predicted: Collection[int] = (),
    ) -> None:  # fmt: skip
        """Add what they say of a frame's pixels to sums `[H, W, 4]` and squares `[H, W]`, as `add_photo` does, from all but those of the
        moments `predicted`."""
        assert frame.instance is not None and frame.depth is not None
        mine = (frame.instance == self.instance) & clear
        part = _around(mine)
        pose = next((p.world_from_local for p in placed if p.instance == self.instance), None)
        if part is None or pose is None:
            return
        eye = (inverse(pose) @ frame.camera.world_from_cam)[:3, 3] - self.centre
        here = max(frame.camera.lens.focal()) / max(float(eye.norm()), 1e-3)
        told = [t[part].contiguous() for t in (rays, frame.depth, sums, squares)]
        seen = mine[part].contiguous()
        for index, share, angle in self._chosen(eye, here, predicted):
            # what is seen from another side is off as if the eyes were as far apart
            off = angle * float(eye.norm()) / PARALLAX
            kinds = (wp.vec3, float, wp.vec4, float)
            run_over(add_photo, frame, placed, seen, self._seen(index, here), [share, NOISE, off, *zip(told, kinds, strict=True)], part)
        sums[part], squares[part] = told[2], told[3]

    def _chosen(self, eye: torch.Tensor, here: float, predicted: Collection[int]) -> list[tuple[int, float, float]]:
        """The photos from the nearest directions and sharpest, their shares of 0 to 1, and radians between their directions and the eye's;
        here: pixels that a metre of the asset has in the frame."""
        along = F.cosine_similarity(self.eyes, eye[None], dim=-1).clamp(-1, 1)
        angles = torch.arccos(along)
        scores = (self.pixels / here).clamp_max(1) / (NEAR + angles)
        scores *= torch.tensor([p.camera.time_us not in predicted for p in self.photos])
        return [(i, share, float(angles[i])) for i, share in faded(scores)]

    def _seen(self, index: int, here: float) -> Seen:
        """What a photo adds to the splats, about as sharp as the frame, so that nothing is skipped between its pixels."""
        level = min(0, round(2 * math.log2(here / float(self.pixels[index]))))
        key = (index, level)
        if key not in self.kept:
            self.kept[key] = self._difference(self.photos[index], 2 ** (level / 2))
        self.kept.move_to_end(key)
        while len(self.kept) > KEPT:
            self.kept.popitem(last=False)
        return self.kept[key]

    def _difference(self, photo: AssetPhoto, shrink: float) -> Seen:
        camera = photo.camera
        camera = camera.resized(max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink)))
        placed = Placed(self.asset.gaussians, torch.eye(4, dtype=torch.float64), instance=self.instance)
        frame = rasterize(placed, camera, ("rgb", "alpha", "depth", "instance"), model=self.model_for(camera))
        assert isinstance(frame, Frame) and frame.rgb is not None and frame.alpha is not None and frame.instance is not None
        rgba = torch.from_numpy(photo.read()).to(frame.rgb).permute(2, 0, 1)[None] / 255
        rgba = torch.cat([rgba[:, :3] * rgba[:, 3:], rgba[:, 3:]], 1)  # of what is not the asset no colour counts
        rgba = F.interpolate(rgba, (camera.height, camera.width), mode="area")[0].permute(1, 2, 0)
        shows = (rgba[..., 3] > 0.99) & (frame.instance == self.instance)
        rgb, shown = frame.rgb / frame.alpha.clamp_min(1e-6)[..., None], rgba[..., :3] / rgba[..., 3:].clamp_min(1e-6)
        differs = torch.zeros_like(rgb)
        if int(shows.sum()) >= FEWEST:
            gain = (rgb[shows].mean(0) / shown[shows].mean(0).clamp_min(1e-3)).clamp(1 / BRIGHTER, BRIGHTER)
            differs = _detail((shown * gain).clamp(0, 1) - rgb.clamp(0, 1), shows)
        instance = torch.where(shows, self.instance, GONE)
        return Seen.of(frame, F.pad(differs, (0, 1)), instance, [placed])


def portraits_of(scene: Scene) -> list[Portraits]:
    """The photos of those actors of a scene whose assets have any."""
    return [Portraits(actor, i + 1, scene.model_for) for i, actor in enumerate(scene.actors) if actor.asset.photos]


def _detail(differs: torch.Tensor, shows: torch.Tensor) -> torch.Tensor:
    """Of a difference `[H, W, 3]` what is no light: without its mean over `SLOW` of the picture around, and 0 where the mask says no."""
    mask = shows.to(differs)[None, None]
    half = max(1, round(SLOW * max(mask.shape[-2:]) / 2))

    def spread(x: torch.Tensor) -> torch.Tensor:
        for _ in range(2):
            x = F.avg_pool2d(F.avg_pool2d(x, (2 * half + 1, 1), 1, (half, 0)), (1, 2 * half + 1), 1, (0, half))
        return x

    given = differs.permute(2, 0, 1)[None] * mask
    return ((given - spread(given) / spread(mask).clamp_min(1e-6)) * mask)[0].permute(1, 2, 0)


def _pixels_a_metre(photo: AssetPhoto, eye: torch.Tensor) -> float:
    return max(photo.camera.lens.focal()) / max(float(eye.norm()), 1e-3)


def _around(mask: torch.Tensor) -> Part | None:
    """Rows and columns that hold all of a mask; None where it is empty."""
    rows, columns = mask.any(1).nonzero(), mask.any(0).nonzero()
    if not len(rows):
        return None
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
