"""The ground is a surface: splats that lie on it are flat, and along it."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
import warp as wp
from scipy import ndimage

from recon.fit.descent import COLOURS, Descent
from recon.fit.model import Splats
from recon.ground import BARE
from recon.kernels.descent import Rates
from recon.kernels.press import Grid, press
from render.launch import run, stage, view
from scenes.ground import Ground
from scenes.poses import matrix_from_quat, quat_from_matrix

PRESSED = 0.008
"""Of its extent across the ground, what a splat on it loses in a step that pulls at it. A picture taken from a car tells hardly how thick a
road is; seen at a grazing angle the upper sides of thick splats hide what is behind, and depth is too near."""

LEVELLED = 0.04
"""Of its axes' tilt against the ground, what it loses in such a step. A splat that is long along a line painted on the road may be turned
in the plane of that line and a straight path without any picture telling: it climbs and goes aside, and 2 m aside the line has teeth."""

PULLED = 0.01
"""Of its height off the ground, what such a splat loses in such a step, along the ray to the eye, so that the picture stays. Pictures of a
straight drive do not tell a line painted along the road from one beside it and higher up; from 2 m aside it lies where it should not, in
shreds. That of splats which overlap the nearer is drawn first, so that depth is a little too near, is no reason to sink them: lines would
be drawn beside where they are."""

LOWEST = 0.3
"""Metres that the eye must be above what is pulled so, or half of how high it is above the ground below it, where that is less."""

ON = 0.08
"""Metres from the ground up to which a splat lies on it, and its standard deviation across it at most: what is thicker stands there."""

UNDER, OVER = 1.0, 0.3
"""`ON`, but below the ground where points show it, and above where they show it bare (`recon.ground.shown_ground`): nothing else is there,
however thick. What pictures of a straight drive leave there is a sixth of what they show of the road, and from 2 m aside as far off as it
is deep."""

NEAR = 0.3
"""Metres from the ground within which what hides a gap there is the street, and stays where and as it lies."""

UNSEEN_PRESSED = 0.1
"""What `PRESSED` is of the rest, of splats on the ground that no picture shows, however thick: where a picture from aside would see between
them they may grow, but along the ground alone, not into fog over it."""

THIN = 0.03
"""Metres of a splat's standard deviation across the ground at most, once it is laid there."""

SMOOTH = 1.0
"""Metres over which the ground's slope is taken: a kerb is no ramp."""


class FlatGround:
    """Presses splats onto a ground, on its device. shown: what is known of it, uint8 `[Y, X]` (`recon.ground.shown_ground`)."""

    def __init__(self, ground: Ground, shown: torch.Tensor, device: torch.device):
        self.ground = ground
        smooth = ndimage.gaussian_filter(ground.heights.double().numpy(), SMOOTH / ground.cell, mode="nearest")
        along_y, along_x = np.gradient(smooth, ground.cell)
        self.slopes = torch.from_numpy(np.stack([along_x, along_y], -1)).float().to(device)
        self.heights = ground.heights.to(device).contiguous()
        self.near = torch.stack([torch.where(shown > 0, UNDER, ON), torch.where(shown == BARE, OVER, ON)], 2).to(device)
        self.grid = Grid()
        (self.grid.x, self.grid.y), self.grid.cell = ground.origin, ground.cell
        self.origin = torch.tensor(ground.origin, device=device)

    def on(self, splats: Splats) -> torch.Tensor:
        """Which splats, bool `[N]`, are background and nearer than `NEAR` to the ground. To hide a gap there it would pay to rise and to
        turn up, too, as fog over the road that no recorded picture shows."""
        means = splats.fields["means"].detach()
        near = (means[:, 2] - self.heights[self._cells(means)]).abs() < NEAR
        near[splats.sizes[0] :] = False
        return near

    def lay(self, splats: Splats, which: torch.Tensor) -> None:
        """Put splats, bool `[N]`, onto the ground and flatten them, in place: such as no picture shows, of which nothing else is known."""
        means = splats.fields["means"][which]
        z = self.ground.height(means[:, :2].cpu()).to(means)
        up = F.normalize(torch.cat([-self.slopes[self._cells(means)], torch.ones_like(z)[:, None]], 1))
        axes = matrix_from_quat(splats.fields["quats"][which]) * splats.fields["log_scales"][which].exp()[:, None]
        across = (axes * up[:, :, None]).sum(1, keepdim=True)
        lost = (1 - THIN / across.norm(dim=2, keepdim=True)).clamp_min(0)
        axes = axes - lost * up[:, :, None] * across
        turned, extents, _ = torch.linalg.svd(axes)
        turned[:, :, 2] *= torch.linalg.det(turned)[:, None]
        splats.fields["means"][which] = torch.cat([means[:, :2], z[:, None]], 1)
        splats.fields["quats"][which] = quat_from_matrix(turned)
        splats.fields["log_scales"][which] = extents.clamp_min(1e-6).log()

    def _cells(self, means: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Row and column `[N]` of the cells nearest to means `[N, 3]`, those at the edge of what is beyond."""
        (rows, columns), at = self.heights.shape, (means[:, :2] - self.origin) / self.ground.cell
        x, y = at.round().long().T
        return y.clamp(0, rows - 1), x.clamp(0, columns - 1)

    def press(self, splats: Splats, which: torch.Tensor, descent: Descent, rates: Rates, settle: float, eye: torch.Tensor) -> None:
        """Flatten those of the splats at indices `which` `[M]` that are background, lie on the ground, and were moved in the step
        `rates.now`, by `settle` of what a step does."""
        fields = [view(splats.fields[name], kind) for name, kind in (("means", wp.vec3), ("quats", wp.vec4), ("log_scales", wp.vec3))]
        with stage(which.device):
            moved = [view(which, wp.int64), splats.sizes[0], view(descent.last, float), rates.now]
            ground = [
                self.grid,
                view(self.heights, float),
                view(self.slopes, wp.vec2),
                view(self.near, wp.vec2),
                settle * PRESSED,
                settle * LEVELLED,
            ]
            high = float(eye[2] - self.ground.height(eye[None, :2].cpu()))
            lowest = min(LOWEST, high / 2) if high > 0 else LOWEST
            pull = [wp.vec3(*eye.tolist()), lowest, settle * PULLED]
            unseen = [view(descent.moments, float), COLOURS, settle * UNSEEN_PRESSED]
            run(press, len(which), [*moved, *ground, *pull, *unseen, *fields], which.device)
