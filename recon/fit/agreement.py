"""A photo of another moment, moved into a view by the view's depth, should look as the view's own photo does.

Splats that explain each photo from the path may lie off their surface by a hundredth of their distance, which a view from beside the path
shows as edges a pixel beside where they are. Two photos taken metres apart tell depth to a fraction of a pixel (Godard et al. 2019,
"Monodepth2", equations 2 to 5; of splats Chen et al. 2024, "PGSR", section 3.3). Only what stands still is compared: what moves is where
its boxes say, which are not as exact.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
import warp as wp

from recon.fit.losses import Lattice
from recon.fit.motion import Motion, Shot
from recon.fit.targets import ego_at
from recon.kernels.agreement import Picture, Readouts, look_kernel
from recon.views.view import View
from render.flat_field import evened
from render.kernels.lenses import LENS_FUNCTIONS
from render.launch import run_pixels, stage, upload, view
from render.projection import optics_of
from render.rays import camera_rays, on_device
from scenes.poses import inverse

NEAREST, FARTHEST = 1 / 3, 2.0
"""Way between two photos that are compared, in parts of how far aside of the path a scene is to be seen."""

BEGINS = 0.15
"""Part of the fit from which photos are compared: before, pictures are too coarse to tell."""

WEIGHT, STEP = 2.0, 2
"""What the photos' difference weighs beside the picture's loss; less as steps settle, so that the last word is the picture's. And at every
how many rows and columns they are compared."""

SOLID = 0.9
"""Alpha from which on a pixel's depth is one surface's."""

OTHER, AROUND = 0.08, 3
"""Mean difference of colours, over so many places along each side, from which on two photos show different things: one of them something
nearer."""


class Agreement:
    """The photos that each training view is compared with, and what their disagreement costs."""

    def __init__(self, training: Sequence[View], motion: Motion, metres: float):
        """metres: how far aside of the path the scene is to be seen."""
        self.motion = motion
        eyes = torch.stack([motion.camera(v).world_from_cam[:3, 3].detach() for v in training])
        way, camera = torch.cdist(eyes, eyes), torch.tensor([v.camera for v in training])
        near = (way >= NEAREST * metres) & (way <= FARTHEST * metres) & (camera[:, None] == camera)
        some = [[training[k] for k in row.nonzero()[:, 0].tolist()] for row in near]
        self.others = {(v.camera, v.index): views for v, views in zip(training, some, strict=True)}

    def other(self, mine: View, generator: torch.Generator) -> View | None:
        """A view to compare a view with, another one each time; None where there is none."""
        some = self.others[mine.camera, mine.index]
        return some[int(torch.randint(0, len(some), (), generator=generator))] if some else None

    def sampled(
        self, shot: Shot, drawn: dict[str, torch.Tensor], photos: tuple[torch.Tensor, torch.Tensor], other: View, field: torch.Tensor,
        generator: torch.Generator,
    ) -> torch.Tensor:  # fmt: skip
        """What a shot's photo and another view's cost that differ, compared at some of their pixels; field: their camera's flat field."""
        target, photo = (evened(picture, field) for picture in photos)
        lattice = (STEP, *torch.randint(0, STEP, (2,), generator=generator).tolist())
        return WEIGHT * self.cost(shot, drawn, target, other, photo, lattice)

    def cost(
        self, shot: Shot, drawn: dict[str, torch.Tensor], target: torch.Tensor, other: View, photo: torch.Tensor, lattice: Lattice
    ) -> torch.Tensor:
        """What a shot's photo, `target` `[H, W, 3]`, and another view's `photo` differ by where the shot's splats are, in the mean over
        pixels; differentiable in depth.

        drawn: "depth", "alpha" and "instance" `[H, W]`. lattice: where they are compared. Both photos are as a lens shows them that shows
        all of its picture alike. What another thing hides in one of them does not count (their difference tells), nor what looks more alike
        if it is not moved: the recording car's shade, which it takes along, and what is too far off.
        """
        if other.gain is not None and shot.view.gain is not None:
            photo = photo * (shot.view.gain / other.gain)
        if other.ego is not None:
            photo = photo.masked_fill(ego_at(other, shot.camera), torch.nan)
        found, slopes = self._looked(shot, {name: t.detach() for name, t in drawn.items()}, target, other, photo, lattice)
        moved, still, known = F.avg_pool2d(found[None], AROUND, 1, AROUND // 2)[0]
        same = (found[2] > 0) & (moved < OTHER * known) & (moved <= still)
        # to first order in how much deeper a pixel is than it is, which is 0: its gradient is how the photos' difference changes
        step, top, left = lattice
        depth = drawn["depth"][top::step, left::step]
        deeper = torch.where(same, depth / depth.detach(), 1.0) - 1
        return torch.where(same, found[0] + slopes * deeper, 0.0).mean()

    @torch.no_grad()
    def _looked(
        self, shot: Shot, drawn: dict[str, torch.Tensor], target: torch.Tensor, other: View, photo: torch.Tensor, lattice: Lattice
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """What another view's photo shows of a shot's street `[3, h, w]`, and its slopes `[h, w]`, as of `look_kernel`."""
        device, camera = target.device, shot.camera
        there = self.motion.shot(other, (camera.width, camera.height))
        ways = upload(_street(there)[:, None] @ inverse(_street(shot))[None], device)
        picture, readouts, rays = Picture(), Readouts(), on_device(camera_rays(camera), device)
        step, *first = lattice
        size = [len(range(begin, side, step)) for begin, side in zip(first, target.shape, strict=False)]
        found, slopes = torch.empty(3, *size, device=device), torch.empty(size, device=device)
        instance = drawn["instance"].to(torch.int32)
        with stage(device):
            readouts.ways = wp.from_torch(ways.contiguous(), wp.mat44d)
            readouts.by_columns = int(self.motion.rig[other.camera].shutter == "columns")
            picture.rays, picture.photo = wp.from_torch(rays, wp.vec3), wp.from_torch(target.contiguous(), wp.vec3)
            picture.depth, picture.alpha = (wp.from_torch(drawn[name].contiguous()) for name in ("depth", "alpha"))
            picture.instance = wp.from_torch(instance.contiguous())
            told = [picture, readouts, SOLID, optics_of(there.camera.lens, camera.width), view(photo.contiguous(), wp.vec3)]
            kernel = look_kernel(LENS_FUNCTIONS[there.camera.lens.kind])
            run_pixels(kernel, slopes.numel(), [*told, *lattice, view(found, float), view(slopes, float)], device)
        return found, slopes


def _street(shot: Shot) -> torch.Tensor:
    """cam_from_world `[2, 4, 4]` as a shot's readout begins and as it ends."""
    return torch.stack(shot.backs())
