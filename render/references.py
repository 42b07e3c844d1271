"""What the photos of a drive know of a rendered view: detail that splats blur, brought there by the render's own depth.

A photo and the render at its place differ by what the splats do not explain. That difference is moved into the view, not the photo itself:
it has hardly any low frequencies, so nothing jumps where a photo ends, and exposures, edits and shadows of inserted objects stay as they
were rendered. An actor's difference moves with the actor; where another instance, or nothing that a photo shows, is drawn, there is none;
nor is there any of a photo's noise (`render/photo_noise.py`). Photos are chosen and faded in and out as views of an unstructured lumigraph
(Buehler et al. 2001) and summed as a Wiener filter sums estimates of known noise, which grows with parallax: it was measured on drive 002's
side cameras, on frames that no fit had seen. Of what was put in, the photos that its asset was cut out of say as much
(`render/portraits.py`).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import torch
import warp as wp
from torch.nn import functional as F

from render.flat_field import in_flat_field
from render.frame import render_frame
from render.frame_types import Frame
from render.kernels.detail import add_photo, carry_over
from render.photo_noise import without_noise
from render.portraits import portraits_of
from render.rays import camera_rays, on_device
from render.seen import GONE, NOISE, PARALLAX, PHOTOS, Seen, faded, run_over
from scenes.asset import Asset
from scenes.camera import DARKEST, Camera
from scenes.gaussians import Placed
from scenes.poses import inverse
from scenes.scene import Scene

READS = ("rgb", "alpha", "depth", "instance")
"""Outputs of the frames that references are found for."""

NEAR, SPEED = 0.5, 2.0
"""Metres that are near, and metres a second: a photo of another moment counts as farther by what may have moved since."""

SPACING = 1.3
"""Metres, by the same measure, between photos that are enough for a view from farther off than that: each costs a render."""

FARTHEST = 200.0
"""Metres at which the sky is taken to be when photos are chosen."""

COVERED, RIM = 0.3, 2
"""Alpha above which something stands before the sky, and pixels around it whose detail may be its own and go astray with the sky."""

GRID = 12, 20
"""Points of a view, down and across, by which photos are chosen."""

AT_ONCE = 64
"""Photos that are asked what they show of a view, from the nearest on, until none that is farther off could be chosen."""

APART = 0.06
"""Spread of what photos add to the sky at which little of it is believed: what differs is no sky but wires that no splats stand for."""

BORDER = 0.1
"""Part of a photo's side over which a point counts as leaving it: a step of GRID."""

CARRIED = 0.5
"""Of the detail of the frame before, moved along: it calms what photos that are faded in and out make flicker."""

KEPT = 12
"""Photos whose difference is kept for the next frames."""


@dataclass(frozen=True)
class Shot:
    """A photo that a scene was made from: the scene's camera there, at the photo's own size, and `read(width, height)`, which gives it at
    a size as uint8 `[H, W, 3]`. ego: bool `[h, w]` at any size, where it shows the recording car itself; None where nowhere."""

    camera: Camera
    read: Callable[[int, int], np.ndarray]
    ego: np.ndarray | None = None


class References:
    """The shots of a scene, and the photos of assets that stand in it, for the frames of clips of it."""

    def __init__(self, shots: Sequence[Shot], recorded: Scene, shown: Scene | None = None):
        """recorded: the scene as it was when the photos were taken; shown: as the frames show it, with edits; the same where None."""
        self.shots, self.recorded, self.shown = list(shots), recorded, shown or recorded
        now = {actor.track: (i + 1, actor.asset) for i, actor in enumerate(self.shown.actors)}
        ids = [_id_of(actor.asset, *now.get(actor.track, (GONE, None))) for actor in recorded.actors]
        self.ids = torch.tensor([0, *ids, -1])  # the last is the sky's, -1
        self.eyes = torch.tensor([s.camera.world_from_cam[:3, 3].tolist() for s in shots], dtype=torch.float64).reshape(-1, 3)
        self.times = torch.tensor([s.camera.time_us for s in shots])
        self.back = inverse(torch.stack([s.camera.world_from_cam for s in shots])) if shots else torch.zeros(0, 4, 4, dtype=torch.float64)
        alike: dict[tuple, list[int]] = {}
        for i, shot in enumerate(shots):
            alike.setdefault((shot.camera.lens.key(), shot.camera.width, shot.camera.height), []).append(i)
        self.spare, self.kind = torch.zeros(len(shots), dtype=torch.bool), torch.zeros(len(shots), dtype=torch.int64)
        for kind, indices in enumerate(alike.values()):
            self.kind[indices] = kind
            last = indices[0]
            for i in indices[1:]:
                self.spare[i] = self._off(shots[i].camera)[last] < SPACING
                last = last if self.spare[i] else i
        self.kept: OrderedDict[tuple[int, int], Seen] = OrderedDict()
        self.portraits = portraits_of(self.shown)

    @torch.no_grad()
    def along(self, frames: Iterable[Frame], predicted: Sequence[Camera] = ()) -> Iterator[Frame]:
        """The frames of a clip, which have the outputs READS, each with its `reference` and `trust` as soon as it comes.

        predicted: the clip's cameras, where its photos are to be predicted: then neither a frame's own photo is looked at nor those of the
        frames to come, whose detail would be carried over to them.
        """
        last: Seen | None = None
        for i, frame in enumerate(frames):
            assert frame.rgb is not None and frame.depth is not None and frame.instance is not None
            placed, clear = self.shown.placed(frame.camera.time_us), ~_mixed(frame)
            detail = self._detail(frame, placed, clear, predicted[i:])
            if last is not None:
                run_over(carry_over, frame, placed, clear, last, [CARRIED, (detail, wp.vec4)])
            last = Seen.of(frame, detail, torch.where(clear, frame.instance, GONE), placed)
            trust = detail[..., 3].clamp(0, 1)  # where it was carried, a cubic may overshoot
            difference = detail[..., :3] * _gain(self.shown, frame)
            reference = torch.addcdiv(frame.rgb, difference, trust.clamp_min(1e-9)[..., None])
            yield replace(frame, reference=reference.clamp_(0, 1), trust=trust)

    def _detail(self, frame: Frame, placed: list[Placed], clear: torch.Tensor, predicted: Sequence[Camera]) -> torch.Tensor:
        """What the photos add to a frame, and how far that is to be trusted, `[H, W, 4]`: the former is weighted by the latter already."""
        assert frame.rgb is not None and frame.depth is not None and frame.instance is not None
        sums, squares = frame.rgb.new_zeros(*frame.rgb.shape[:2], 4), torch.zeros_like(frame.depth)
        rays = on_device(camera_rays(frame.camera), frame.depth.device)
        for index, share in self.chosen(frame, predicted):
            baseline = float((self.eyes[index] - frame.camera.world_from_cam[:3, 3]).norm())
            told = [share, NOISE, baseline / PARALLAX, (rays, wp.vec3), (frame.depth, float), (sums, wp.vec4), (squares, float)]
            run_over(add_photo, frame, placed, clear, self._seen(index, frame.camera, frame.rgb.device), told)
        moments = {camera.time_us for camera in predicted}
        for portraits in self.portraits:
            portraits.add(frame, placed, clear, rays, sums, squares, moments)
        weight = sums[..., 3]
        some = weight.clamp_min(1e-9)
        spread = squares / some - (sums[..., :3] / some[..., None]).square().mean(-1)
        agree = torch.where(frame.instance < 0, torch.exp(_largest(spread, 1) / -(APART**2)), 1.0)
        return sums * (agree / (1 + weight))[..., None]

    def chosen(self, frame: Frame, predicted: Sequence[Camera] = ()) -> list[tuple[int, float]]:
        """The shots that show most of a frame from nearby, best first, and a share of 0 to 1 for each; continuous along a path; none
        that was taken as one of `predicted`."""
        if not self.shots:
            return []
        return faded(self._scores(frame, predicted))

    def _scores(self, frame: Frame, predicted: Sequence[Camera]) -> torch.Tensor:
        """float64 `[S]`: the share of a frame that each shot shows, as sharply, by how far off it was taken; 0 of those too far off to be
        among the best."""
        camera = frame.camera
        assert frame.depth is not None
        y, x = (
            (torch.arange(n, dtype=torch.float32) + 0.5) * side / n for n, side in zip(GRID, (camera.height, camera.width), strict=True)
        )
        at = y.long()[:, None], x.long()
        depth = frame.depth.cpu()[at].clamp_max(FARTHEST)
        rays = camera_rays(camera)[at]
        seen = (rays != 0).any(-1)  # past the edge of a fisheye's image there is nothing to show
        points = (rays[seen] * depth[seen, None]).double() @ camera.world_from_cam[:3, :3].T + camera.world_from_cam[:3, 3]
        detail = camera.lens.focal()[0] / camera.width / depth[seen]
        off, scores = self._off(camera), torch.zeros(len(self.shots), dtype=torch.float64)
        own = torch.zeros(len(self.shots), dtype=torch.bool)
        for other in predicted:
            own |= ((self.eyes - other.world_from_cam[:3, 3]).norm(dim=-1) < 1e-6) & (self.times == other.time_us)
        nearest = torch.inf
        for some in off.argsort().split(AT_ONCE):
            if (scores.topk(min(PHOTOS + 1, len(scores))).values[-1] >= 1 / (NEAR + off[some[0]])).item():
                break
            shows = self._shows(some, points, detail).masked_fill(own[some], 0)
            if nearest == torch.inf and (shows > 0).any():
                nearest = float(off[some[shows > 0]].min())
            shows[self.spare[some]] *= min(max(3 - 2 * nearest / SPACING, 0.0), 1.0)
            scores[some] = shows / (NEAR + off[some])
        return scores

    def _shows(self, some: torch.Tensor, points: torch.Tensor, detail: torch.Tensor) -> torch.Tensor:
        """float64 `[n]`: the share of points `[P, 3]` that each of `some` shots shows, as sharply as `detail` `[P]`."""
        shows = torch.zeros(len(some), dtype=torch.float64)
        for kind in self.kind[some].unique().tolist():
            alike = self.kind[some] == kind
            shot = self.shots[int(some[alike][0])].camera
            back = self.back[some[alike]]
            local = points @ back[:, :3, :3].transpose(1, 2) + back[:, None, :3, 3]
            pixels = shot.lens.project(local)
            side = torch.tensor([shot.width, shot.height])
            # across the border by and by: rows of points that leave at once would make photos jump
            inside = (torch.minimum(pixels, side - pixels) / (BORDER * side) + 0.5).clamp(0, 1).prod(-1) * shot.lens.valid(local)
            there = shot.lens.focal()[0] / shot.width / shot.lens.depth(local).clamp_min(1e-6)
            shows[alike] = (inside * (there / detail).clamp_max(1)).mean(-1)
        return shows

    def _off(self, camera: Camera) -> torch.Tensor:
        """float64 `[S]`: metres from a camera to each shot, and what may have moved in the time between them."""
        return (self.eyes - camera.world_from_cam[:3, 3]).norm(dim=-1) + SPEED * 1e-6 * (self.times - camera.time_us).abs()

    def _seen(self, index: int, seer: Camera, device: torch.device) -> Seen:
        """What a shot adds to the splats, in at most as many pixels a radian as the frames have, so that none is skipped."""
        shot = self.shots[index]
        shrink = min(1.0, seer.lens.focal()[0] / shot.camera.lens.focal()[0])
        width, height = (max(1, round(side * shrink)) for side in (shot.camera.width, shot.camera.height))
        key = (index, width)
        if key not in self.kept:
            camera = shot.camera.resized(width, height)
            frame = render_frame(self.recorded, camera, READS)
            assert frame.rgb is not None and frame.instance is not None
            photo = torch.from_numpy(np.array(shot.read(camera.width, camera.height))).to(device).float() / 255
            placed = [replace(p, instance=int(self.ids[p.instance])) for p in self.recorded.placed(camera.time_us)]
            instance = torch.where(_mixed(frame), GONE, self.ids.to(device)[frame.instance.long()])
            if shot.ego is not None:
                ego = torch.from_numpy(shot.ego).to(device)[None, None].float()
                instance = torch.where(F.interpolate(ego, instance.shape)[0, 0] > 0, GONE, instance)
            differs = without_noise(photo - frame.rgb.clamp(0, 1), photo) / _gain(self.recorded, frame)
            self.kept[key] = Seen.of(frame, F.pad(differs, (0, 1)), instance, placed)
        self.kept.move_to_end(key)
        while len(self.kept) > KEPT:
            self.kept.popitem(last=False)
        return self.kept[key]


def _gain(scene: Scene, frame: Frame) -> torch.Tensor:
    """How many times as bright as a scene's splats are they are shown, `[H, W, 3]`: what a photo adds is shown alike."""
    assert frame.rgb is not None and frame.instance is not None
    exposure, followed = frame.camera.exposure, scene.followed(frame.camera.time_us)
    gain = torch.ones(3, dtype=torch.float32) if exposure is None else exposure[:, :3].diagonal().clamp_min(DARKEST)
    lit = gain.to(frame.rgb).expand_as(frame.rgb)
    if followed is not None:
        each = torch.stack([gain, *(gain / followed if actor.recorded else gain for actor in scene.actors)])
        lit = each.to(frame.rgb)[frame.instance.long().clamp_min(0)]
    return in_flat_field(lit, frame.camera.flat_field)


def _id_of(asset: Asset, instance: int, shown: Asset | None) -> int:
    """An actor's instance in the frames; GONE where these show none of its track, or put another thing in its place."""
    return instance if shown is not None and torch.equal(asset.gaussians.means, shown.gaussians.means) else GONE


def _mixed(frame: Frame) -> torch.Tensor:
    """Sky, bool `[H, W]`, before which wires and twigs stand or near which anything does."""
    assert frame.alpha is not None and frame.instance is not None
    return (_largest((frame.alpha > COVERED).float(), RIM) > 0) & (frame.instance < 0)


def _largest(image: torch.Tensor, around: int) -> torch.Tensor:
    """Of `[H, W]` the largest value up to `around` pixels away, in rows and columns, one after the other: by shifts of the whole, which
    takes a fifth of a pooling's time."""
    for axis in (0, 1):
        beyond = (0, 0, around, around) if axis == 0 else (around, around)
        padded, count = F.pad(image, beyond, value=-torch.inf), image.shape[axis]
        image = reduce(torch.maximum, (padded.narrow(axis, first, count) for first in range(2 * around + 1)))
    return image
