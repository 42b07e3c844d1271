"""Where light from the sky may come from, and where a scene must be closed: the road, and whatever always stands before the sky."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F

from recon.fit.behind import masked, sampled
from recon.fit.motion import Motion
from recon.seeds.measured import Measured, nearer
from recon.side_by_side import side_by_side
from recon.views.frames import Frames
from recon.views.skies import always_hidden
from recon.views.view import View
from render.rays import world_directions
from scenes.camera import Camera
from scenes.spread import spread

SKY_WEIGHT, LEFT = 0.1, 0.02
"""Of the cross entropy of alpha with none, in pixels that are surely sky, beside the picture's loss; and the light that shines through even
where alpha is 1, so that it is finite. In the picture splats of the sky's colour are as good as the sky: at a roof's edge, or between
wires, they would stay, and from elsewhere hang beside it in white streaks. Of opaque ones before one another each has its part so; alpha
itself, which the last of them alone could change, left 1.3 % of drive 002's sky opaque, now 0.1 %."""

SOLID_WEIGHT = 0.1
"""Of 1 - alpha of pixels below the horizon: a road that the sky shines through looks right from the recorded path alone."""

ASIDE, WITHIN, ASIDE_WEIGHT = 3.0, 0.25, 0.3
"""Metres to either side of the path from which the road must be closed too, and what always hides the sky, and the weight of that; as far
as what this part of the pictures show at most, since indoors cameras 3 m aside are behind a wall."""

LOOKS = 40
"""Pictures of a camera by which it is known where the sky is never seen."""

HORIZON = -0.01
"""Rays that fall more than this (half a degree) are below the horizon where no photo says what is sky."""


def aside_of(measured: Sequence[Measured]) -> float:
    """Metres to either side of the path from which a scene must be closed, by the depths in pictures."""
    return min(ASIDE, nearer(measured, WITHIN))


class Openings:
    """What a fit's pictures say of the sky.

    sky     by a training view's camera and index, what of it is surely sky, bool `[H, W]`
    hidden  bool `[HIDDEN, 2 HIDDEN]`: directions in which none of them shows it, though some look there (`recon/views/skies.py`)
    metres  to either side of the path from which a scene must be closed (`aside_of`)
    """

    def __init__(self, frames: Frames, motion: Motion, device: torch.device, metres: float):
        self.motion, self.device, self.metres = motion, device, metres
        views = frames.training()
        masks = side_by_side(frames.sky_with_rim, views)
        self.sky = {(v.camera, v.index): torch.from_numpy(mask).to(device) for v, mask in zip(views, masks, strict=True)}
        looks = []
        for c in range(len(frames.names)):
            for view in spread(frames.of(c), LOOKS):
                h, w = view.sky.shape
                looks.append((view.sky.numpy(), motion.camera(view).resized(w, h)))
        self.hidden = always_hidden(looks).to(device)

    def backdrop(self, sky: torch.Tensor, generator: torch.Generator) -> Callable[[torch.Tensor], torch.Tensor]:
        """What lies behind everything, colours `[h, w, 3]` by directions `[h, w, 3]` in the world: the sky `[H, 2H, 3]`, and where no
        picture shows it any one grey, another one each time. A bright sky below the road would be the cheapest light at the edges of shade,
        and leave holes there."""
        grey = float(torch.rand(1, generator=generator))

        def behind(directions: torch.Tensor) -> torch.Tensor:
            open_ = ~masked(self.hidden, directions)
            # what is looked up between directions is of both: no grey beside a direction that is open
            beside = F.max_pool2d(open_[None, None].float(), 3, 1, 1)[0, 0, :, :, None] > 0
            return torch.where(beside, sampled(sky, directions), grey)

        return behind

    def haze(self, alpha: torch.Tensor, view: View, camera: Camera) -> torch.Tensor:
        """What it costs that alpha `[H, W]`, as a view's camera sees it, is above 0 before the sky and below 1 under the horizon."""
        sky = self.sky[view.camera, view.index]
        if sky.shape != alpha.shape:
            sky = F.interpolate(sky[None, None].float(), alpha.shape, mode="area")[0, 0]
        before = -(sky * torch.log1p(-alpha / (1 + LEFT))).mean()
        coarse = F.interpolate(alpha[None, None], view.sky.shape)[0, 0]
        small = camera.resized(view.sky.shape[1], view.sky.shape[0])
        solid = (world_directions(small, self.device)[..., 2] < 0) & ~view.sky
        return SKY_WEIGHT * before + SOLID_WEIGHT * ((1 - coarse) * solid).mean()

    def beside_sky(self, view: View, camera: Camera) -> torch.Tensor:
        """Pixels `[h, w]` of a camera that sees what a view does that are, or touch, sky: 1, others 0."""
        sky = self.sky[view.camera, view.index][None].float()
        return F.max_pool2d(F.adaptive_max_pool2d(sky, (camera.height, camera.width)), 3, 1, 1)[0]

    def aside(self, view: View, camera: Camera, metres: float) -> Camera:
        """A view's camera, so many metres farther left, or right below 0."""
        pose = camera.world_from_cam.detach().clone()
        pose[:3, 3] += metres * self.motion.left(view)
        return replace(camera, world_from_cam=pose)

    def gaps(self, alpha: torch.Tensor, camera: Camera) -> torch.Tensor:
        """What it costs that alpha `[H, W]`, as a camera from aside sees it, is below 1 under the horizon or where the sky is hidden."""
        directions = world_directions(camera, self.device)
        closed = (directions[..., 2] < HORIZON) | masked(self.hidden, directions)
        return ASIDE_WEIGHT * ((1 - alpha) * closed).mean()
