"""How far a picture jumps while a camera turns in steps of 0.1 degrees: order by tile, where splats pop, beside order by pixel.

A turn moves every edge by 0.1 pixels, and a pixel that it passes changes at once in any picture. What pops is larger than that: so the
change is that of the mean of PATCH x PATCH pixels, of which an edge can change 0.1 / PATCH.

    python -m tests.bench.popping [--splats 3000] [--steps 100]
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import torch

from render import RenderConfig, rasterize
from scenes.camera import Camera
from scenes.gaussians import Gaussians
from scenes.lenses import Pinhole
from scenes.poses import pose_from
from tests.bench.measure import timed

STEP = math.radians(0.1)
PATCH = 8
CUTOFF = 1 / 4096
"""Low, so that what is counted is order and not splats' edges."""


def thicket(count: int) -> Gaussians:
    """Long splats of plain colours that cross each other in every direction: the order of centres says little of that on a ray."""
    dice = torch.Generator().manual_seed(3)
    means = torch.randn(count, 3, generator=dice) * torch.tensor([2.0, 1.5, 1.0]) + torch.tensor([0.0, 0.0, 5.0])
    log_scales = torch.tensor([-0.5, -2.0, -2.0]) + 0.3 * torch.randn(count, 3, generator=dice)
    colours = torch.randint(0, 2, (count, 1, 3), generator=dice) * 3.5 - 1.75
    return Gaussians(means, torch.randn(count, 4, generator=dice), log_scales, torch.full((count,), 3.0), colours)


def turned(camera: Camera, step: int) -> Camera:
    half = 0.5 * step * STEP
    return replace(camera, world_from_cam=camera.world_from_cam @ pose_from([math.cos(half), 0.0, math.sin(half), 0.0], [0.0, 0.0, 0.0]))


def steps_of(g: Gaussians, camera: Camera, order: str, steps: int) -> torch.Tensor:
    """Largest change of a patch's mean colour in each step."""
    config = RenderConfig(order=order, alpha_cutoff=CUTOFF)
    frames = [rasterize(g, turned(camera, i), ("rgb",), config=config).rgb for i in range(steps + 1)]
    patches = [torch.nn.functional.avg_pool2d(f.permute(2, 0, 1), PATCH) for f in frames]
    return torch.stack([(b - a).abs().max() for a, b in zip(patches, patches[1:], strict=False)])


def largest_steps(splats: int, steps: int) -> tuple[float, float]:
    """The largest change of any step, by tile and by pixel."""
    camera = Camera(Pinhole(60.0, 60.0, 48.0, 32.0), 96, 64, torch.eye(4, dtype=torch.float64))
    g = thicket(splats)
    by_tile, by_pixel = (float(steps_of(g, camera, order, steps).max()) for order in ("tile", "pixel"))
    return by_tile, by_pixel


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=100)
    args = parser.parse_args()
    camera = Camera(Pinhole(60.0, 60.0, 48.0, 32.0), 96, 64, torch.eye(4, dtype=torch.float64))
    g = thicket(args.splats)
    print(f"{args.splats} crossing splats, 96x64, {args.steps} steps of 0.1 degrees (0.1 pixels): largest change of a patch in a step")
    for order in ("tile", "pixel"):
        changes = steps_of(g, camera, order, args.steps)
        config = RenderConfig(order=order, alpha_cutoff=CUTOFF)
        ms = timed(lambda config=config: rasterize(g, camera, ("rgb",), config=config), 3)
        print(f"  by {order:6} largest {float(changes.max()):6.3f}   median step {float(changes.median()):6.3f}   {ms:7.1f} ms a frame")


if __name__ == "__main__":
    main()
