"""The ground is a surface: splats that lie on it are flat, and along it."""

from __future__ import annotations

import torch
import warp as wp

from recon.fit.model import Splats
from recon.kernels.press import Grid, press
from render.launch import run, stage, view
from scenes.ground import Ground

PRESSED = 0.008
"""Of its extent across the ground, what a splat on it loses in a step that shows it. A picture taken from a car tells hardly how thick a
road is; seen at a grazing angle the upper sides of thick splats hide what is behind, and depth is too near."""

ON = 0.08
"""Metres from the ground up to which a splat lies on it: less than a kerb's height."""


class FlatGround:
    """Presses splats onto a ground, on its device."""

    def __init__(self, ground: Ground, device: torch.device):
        self.heights = ground.heights.to(device).contiguous()
        self.grid = Grid()
        (self.grid.x, self.grid.y), self.grid.cell = ground.origin, ground.cell

    def press(self, splats: Splats, which: torch.Tensor, settle: float) -> None:
        """Flatten what of the splats at indices `which` `[M]` is background and lies on the ground, by `settle` of what a step does."""
        fields = [view(splats.fields[name], kind) for name, kind in (("means", wp.vec3), ("quats", wp.vec4), ("log_scales", wp.vec3))]
        with stage(which.device):
            args = [view(which, wp.int64), splats.sizes[0], self.grid, view(self.heights, float), settle * PRESSED, ON, *fields]
            run(press, len(which), args, which.device)
