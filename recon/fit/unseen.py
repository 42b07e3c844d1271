"""Colours of what the pictures hardly show: a wall behind a tree, the far side of a car, the road beyond a picture's border.

Such a splat is seen by its rim, or by a few pixels between leaves, and Adam's steps, which do not know how little they say, drive its
colour to whatever puts those right, orange or violet. From aside it stands there whole. So it is given the colour of what stands beside it
and is seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from scipy.spatial import cKDTree

from recon.fit.densify import shade_of
from recon.fit.flat import ON
from recon.fit.model import Splats, draw
from scenes.camera import Camera
from scenes.gaussians import Placed
from scenes.ground import Ground
from scenes.harmonics import C0
from scenes.poses import inverse, matrix_from_quat

SEEN = 0.05
"""Part of a splat that the picture showing most of it must show for its colour to be known."""

AT_EDGE = 0.15
"""Part of what pictures show of a splat that is beside the sky, from which on it may be that it stands before the sky."""

LOW = 0.2
"""Metres above the ground up to which a splat is part of the street."""

SWOLLEN = 0.25
"""Metres of standard deviation beyond which a mover's splat that no picture shows has swollen: it began with 0.15 at most."""

NEIGHBOURS = 16
"""Splats of known colour beside one of unknown, whose mean it is given."""

CELL, CELLS = 0.5, 32
"""Metres of a cell of the street, and the nearest of these, of each of which the middle colour counts once, whose middle colour is given to
what is hidden of it. The nearest splats are many small ones of a rim, or of a parked car's sill: black, pale, or as blue as that."""


@dataclass
class Shown:
    """What pictures show of splats `[N]`.

    part: of each one's weight, what stands before it taken off, in the picture that shows most of it: more than 1 where it is narrower than
    a pixel, or at the border of a wide picture (`footprint`), and 0 where its middle is in none. inside: whether that is in any. weight:
    its weight in all pictures, and beside_sky: what of that is in pixels that are, or touch, sky.
    """

    part: torch.Tensor
    inside: torch.Tensor
    weight: torch.Tensor
    beside_sky: torch.Tensor

    @staticmethod
    def none(count: int, device: torch.device | str = "cpu") -> Shown:
        part, weight, beside_sky = torch.zeros(3, count, device=device)
        return Shown(part, torch.zeros(count, dtype=torch.bool, device=device), weight, beside_sky)

    def add(self, which: torch.Tensor, placed: Sequence[Placed], camera: Camera, beside_sky: torch.Tensor, scale: float = 1.0) -> None:
        """Another picture: of splats `which` `[M]`, `placed` as it sees them, with pixels `[H, W]` that are 1 `beside_sky`. scale: as of
        `draw`."""
        groups = [p.gaussians.detach() for p in placed]
        blank = [torch.zeros(len(g), 1, 3, device=g.means.device, requires_grad=True) for g in groups]
        drawn = [replace(p, gaussians=replace(g, sh=sh)) for p, g, sh in zip(placed, groups, blank, strict=True)]
        with torch.enable_grad():
            (rgb,) = draw(drawn, camera, "rgb", scale=scale)
            weights = torch.autograd.grad((rgb[..., 0].sum() + (rgb[..., 1] * beside_sky).sum()) / C0, blank)
        weight, beside = torch.cat(weights)[:, 0, :2].unbind(1)
        whole = torch.cat([footprint(p, camera) for p in placed])
        self.part[which] = torch.maximum(self.part[which], torch.where(whole > 0, weight / whole, 0.0))
        self.inside[which] |= whole > 0
        self.weight[which] += weight
        self.beside_sky[which] += beside


def footprint(placed: Placed, camera: Camera) -> torch.Tensor:
    """Sum of the opacities `[N]` that each splat alone has over a picture's pixels, were it in the middle of it: at the border a pinhole
    draws it larger. 0 where its middle is out of the picture."""
    g = placed.gaussians
    cam_from_local = (inverse(camera.world_from_cam) @ placed.world_from_local).to(g.means)
    middle = g.means @ cam_from_local[:3, :3].T + cam_from_local[:3, 3]
    pixels, size = camera.lens.project(middle), torch.tensor([camera.width, camera.height]).to(middle)
    inside = ((pixels >= 0) & (pixels < size)).all(1) & camera.lens.valid(middle)
    # seen along d, an ellipsoid of axes s is sqrt((s2 s3 d1)^2 + (s1 s3 d2)^2 + (s1 s2 d3)^2) wide
    axes = cam_from_local[:3, :3] @ matrix_from_quat(g.quats)
    along = (axes * middle[:, :, None]).sum(1)
    scales = g.log_scales.exp()
    across = (along / scales).norm(dim=1) * scales.prod(1) / middle.norm(dim=1).pow(3).clamp_min(1e-9)
    fx, fy = camera.lens.focal()
    return 2 * torch.pi * float(fx) * float(fy) * across * torch.sigmoid(g.logit_opacities) * inside


def off_ground(splats: Splats, ground: Ground) -> torch.Tensor:
    """Metres `[N]` by which splats of the background are off the ground, up or down; infinite of others."""
    means = splats.fields["means"].detach().cpu()
    off = (means[:, 2] - ground.height(means[:, :2])).abs().to(splats.reach)
    return torch.where(splats.group_of() == 0, off, torch.inf)


def curtains(splats: Splats, inside: torch.Tensor, pulled: torch.Tensor, ground: Ground) -> torch.Tensor:
    """Which splats of the background, bool `[N]`, stand beyond the pictures' borders and are seen by their rims alone: at their colours
    pictures have `pulled`, though none has their middle `inside`, bool `[N]` both.

    A rim is all that holds such a splat, so it grows as large and as dense as that likes, and from aside it hangs before the street as a
    curtain. What lies on the ground stays: it is the street beyond the border.
    """
    return pulled & ~inside & (off_ground(splats, ground) > LOW) & (splats.group_of() == 0)


def pennants(splats: Splats, shown: Shown, ground: Ground) -> torch.Tensor:
    """Which splats of the background, bool `[N]`, pictures hardly show, and that beside the sky: over a roof, or between wires.

    They begin where a picture had no depth, or grow there, as what stands behind that edge. What little shows of them may be of any colour
    and place, and from aside they hang before the sky.
    """
    at_edge = shown.beside_sky > AT_EDGE * shown.weight
    return (shown.part < SEEN) & at_edge & (off_ground(splats, ground) > LOW) & (splats.group_of() == 0)


def swollen(splats: Splats, part: torch.Tensor) -> torch.Tensor:
    """Which splats of movers, bool `[N]`, none of the pictures shows to `SEEN`, and that are large all the same.

    What another car hides of one ahead is seen by rims, as that sways; these hold such a splat no more than the pictures' borders do a
    curtain, and from aside it lies in a streak over the street.
    """
    large = splats.fields["log_scales"].detach().amax(1) > math.log(SWOLLEN)
    return (part < SEEN) & large & (splats.group_of() > 0) & ~shade_of(splats)


def as_neighbours(splats: Splats, part: torch.Tensor, pulled: torch.Tensor, ground: Ground) -> torch.Tensor:
    """Give splats at whose colours pictures have `pulled`, bool `[N]`, but which none shows to `SEEN`, by the largest `part` `[N]` of each
    in any picture, the colours of their group's nearest others, in place. Returns which these are, bool `[N]`; of groups without any other
    none. These colours do not turn with the view: how others look from where they were seen says nothing of a place that nobody saw, and a
    mean of harmonics turns white and brown to yellow there.

    What stands takes the colours of what stands. What is hidden of the street, pulled at or not, takes the middle colour of the street
    around, channel by channel, cell by cell.
    """
    hidden, known, group = part < SEEN, part >= SEEN, splats.group_of()
    means, sh, off = splats.fields["means"], splats.fields["sh"], off_ground(splats, ground)
    street = known & (off < ON)
    unknown = torch.zeros_like(hidden)
    if street.sum() >= NEIGHBOURS:
        unknown |= hidden & (off < LOW)
        places, colours = _cells(means[street], sh[street])
        _colour(splats, unknown, places, colours, CELLS, lambda found, _: found.median(1).values)
    for i in range(len(splats.sizes)):
        mine = known & (group == i)
        stands = mine & (off > LOW)
        mine = stands if stands.sum() >= NEIGHBOURS else mine  # the road is nearer to most walls than what pictures show of walls
        if mine.sum() >= NEIGHBOURS:
            which = pulled & hidden & (group == i) & ~unknown
            steady = torch.cat([sh[mine, :1], torch.zeros_like(sh[mine, 1:])], 1)
            _colour(splats, which, means[mine], steady, NEIGHBOURS, lambda found, share: (found * share).sum(1))
            unknown |= which
    return unknown


def _cells(means: torch.Tensor, sh: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Of splats' means `[N, 3]` and colours `[N, K, 3]` those of the cells `[C]` of the ground that they lie in: mean place, middle
    colour."""
    _, cell, counts = (means[:, :2] / CELL).floor().long().unique(dim=0, return_inverse=True, return_counts=True)
    parts = cell.argsort().split(counts.tolist())
    return torch.stack([means[p].mean(0) for p in parts]), torch.stack([sh[p].median(0).values for p in parts])


def _colour(
    splats: Splats, which: torch.Tensor, places: torch.Tensor, colours: torch.Tensor, count: int, mix: Callable[..., torch.Tensor]
) -> None:
    """Give splats, bool `[N]`, a mix of the `colours` `[C, K, 3]` of the `count` nearest of `places` `[C, 3]`, in place. mix: of `[M,
    count, K, 3]`, and of how near they are, `[M, count, 1, 1]`, 1 in all."""
    if not which.any():
        return
    at = splats.fields["means"][which].cpu().numpy()
    away, nearest = cKDTree(places.cpu().numpy()).query(at, range(1, min(count, len(places)) + 1))
    wide = splats.fields["log_scales"][which].exp().mean(1)
    share = 1 / (torch.from_numpy(away).to(colours).square() + wide.square()[:, None])
    found = colours[torch.from_numpy(nearest).to(colours.device)]
    splats.fields["sh"][which] = mix(found, (share / share.sum(1, keepdim=True))[:, :, None, None])
