"""How far a picture jumps while a camera turns in steps of 0.1 degrees: order by tile, where splats pop, beside order by pixel.

A turn moves every edge by 0.1 pixels, and a pixel that it passes changes at once in any picture: where two splats reach through each
other, their line of crossing is such an edge, and truth jumps there. What pops is larger than that: so the change is that of the mean of
PATCH x PATCH pixels, of which an edge can change 0.1 / PATCH. Beside it, of single pixels, stands how far a step's change is from the
truth's own (`tests/oracle.py`), at the pixel and the step where the picture changes most.

    python -m tests.bench.popping [--splats 3000] [--steps 100]
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import torch

from render import RenderConfig, rasterize
from scenes.camera import Camera
from scenes.gaussians import Gaussians, Placed, SplatModel
from scenes.lenses import Pinhole
from scenes.poses import pose_from
from tests import oracle
from tests.bench.measure import timed

STEP = math.radians(0.1)
PATCH = 8
CUTOFF = 1 / 4096
"""Low, so that what is counted is order and not splats' edges."""
CAMERA = Camera(Pinhole(60.0, 60.0, 48.0, 32.0), 96, 64, torch.eye(4, dtype=torch.float64))


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


def clip(g: Gaussians, camera: Camera, order: str, steps: int) -> torch.Tensor:
    """Pictures `[steps + 1, H, W, 3]`."""
    config = RenderConfig(order=order, alpha_cutoff=CUTOFF)
    return torch.stack([rasterize(g, turned(camera, i), ("rgb",), config=config).rgb for i in range(steps + 1)])


def patch_steps(pictures: torch.Tensor) -> torch.Tensor:
    """Largest change of a patch's mean colour in each step."""
    patches = torch.nn.functional.avg_pool2d(pictures.permute(0, 3, 1, 2), PATCH)
    return patches.diff(dim=0).abs().amax((1, 2, 3))


def pixel_step(g: Gaussians, camera: Camera, pictures: torch.Tensor) -> tuple[float, float]:
    """The largest change of a pixel in any step, and the truth's change there and then."""
    changes = pictures.diff(dim=0).abs()
    step, row, column, channel = (int(i) for i in torch.unravel_index(changes.argmax(), changes.shape))
    placed = [Placed(g, torch.eye(4, dtype=torch.float64))]
    before, after = (oracle.truth(placed, turned(camera, i), SplatModel())[0][row, column, channel] for i in (step, step + 1))
    return float(changes.max()), float((after - before).abs())


def largest_steps(splats: int, steps: int) -> tuple[float, float]:
    """The largest change of a patch in any step, by tile and by pixel."""
    g = thicket(splats)
    by_tile, by_pixel = (float(patch_steps(clip(g, CAMERA, order, steps)).max()) for order in ("tile", "pixel"))
    return by_tile, by_pixel


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=100)
    args = parser.parse_args()
    g = thicket(args.splats)
    print(f"{args.splats} crossing splats, 96x64, {args.steps} steps of 0.1 degrees (0.1 pixels): largest change in a step\n")
    print("| order | of a patch | median step | of a pixel | of the truth's there | ms a frame |\n|---|---|---|---|---|---|")
    for order in ("tile", "pixel"):
        pictures = clip(g, CAMERA, order, args.steps)
        patches, (pixel, true) = patch_steps(pictures), pixel_step(g, CAMERA, pictures)
        config = RenderConfig(order=order, alpha_cutoff=CUTOFF)
        ms = timed(lambda config=config: rasterize(g, CAMERA, ("rgb",), config=config), 3)
        print(f"| {order} | {float(patches.max()):.3f} | {float(patches.median()):.3f} | {pixel:.3f} | {true:.3f} | {ms:.1f} |")


if __name__ == "__main__":
    main()
