"""The ground is a surface: splats that lie on it are flat, and along it."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp
from scipy import ndimage

from recon.fit.descent import Descent
from recon.fit.model import Splats
from recon.kernels.descent import Rates
from recon.kernels.press import Grid, press
from render.launch import run, stage, view
from scenes.ground import Ground

PRESSED = 0.008
"""Of its extent across the ground, what a splat on it loses in a step that pulls at it. A picture taken from a car tells hardly how thick a
road is; seen at a grazing angle the upper sides of thick splats hide what is behind, and depth is too near."""

ON = 0.08
"""Metres from the ground up to which a splat lies on it, and its standard deviation across it at most: what is thicker stands there."""

SMOOTH = 1.0
"""Metres over which the ground's slope is taken: a kerb is no ramp."""


class FlatGround:
    """Presses splats onto a ground, on its device."""

    def __init__(self, ground: Ground, device: torch.device):
        smooth = ndimage.gaussian_filter(ground.heights.double().numpy(), SMOOTH / ground.cell, mode="nearest")
        along_y, along_x = np.gradient(smooth, ground.cell)
        self.slopes = torch.from_numpy(np.stack([along_x, along_y], -1)).float().to(device)
        self.heights = ground.heights.to(device).contiguous()
        self.grid = Grid()
        (self.grid.x, self.grid.y), self.grid.cell = ground.origin, ground.cell

    def press(self, splats: Splats, which: torch.Tensor, descent: Descent, rates: Rates, settle: float) -> None:
        """Flatten those of the splats at indices `which` `[M]` that are background, lie on the ground, and were moved in the step
        `rates.now`, by `settle` of what a step does."""
        fields = [view(splats.fields[name], kind) for name, kind in (("means", wp.vec3), ("quats", wp.vec4), ("log_scales", wp.vec3))]
        with stage(which.device):
            moved = [view(which, wp.int64), splats.sizes[0], view(descent.last, float), rates.now]
            ground = [self.grid, view(self.heights, float), view(self.slopes, wp.vec2), settle * PRESSED, ON]
            run(press, len(which), [*moved, *ground, *fields], which.device)
