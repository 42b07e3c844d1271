"""What a camera pays for what it does not see: a street of 3M splats culled in clusters, a rig in one call, crops and masks.

python -m tests.bench.culling [--splats 3000000] [--repeat 5]
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace

import numpy as np
import torch

from render import rasterize
from render.cull import bounds, in_sight, splats_in_sight
from scenes.camera import Camera
from scenes.gaussians import Placed
from scenes.poses import pose_from
from tests.bench.measure import timed
from tests.bench.presets import street, uniform


def rig_of(camera: Camera, count: int) -> list[Camera]:
    """Cameras that look all around from one place."""
    turns = [pose_from([math.cos(math.pi * i / count), 0.0, math.sin(math.pi * i / count), 0.0], [0.0, 0.0, 0.0]) for i in range(count)]
    return [replace(camera, world_from_cam=camera.world_from_cam @ turn) for turn in turns]


def those_in_sight(placed: list[Placed], seen: list[np.ndarray | None]) -> list[Placed]:
    """Copies of `placed` without what is not seen."""
    return [replace(p, gaussians=p.gaussians.select(splats_in_sight([p], [s]))) for p, s in zip(placed, seen, strict=True)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, default=3_000_000)
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    preset = street(args.splats)
    (placed,), camera, model = preset.placed, preset.camera, preset.model

    def draw(what, where, **more):
        return rasterize(what, where, ("rgb",), model=model, **more)

    def left(where):
        return those_in_sight([placed], in_sight([placed], where, model))

    # of the directions around, the one in which about a twentieth of the street lies
    camera = min(rig_of(camera, 16), key=lambda c: abs(sum(len(p.gaussians) for p in left(c)) / args.splats - 0.05))
    few_left = left(camera)
    seen = sum(len(p.gaussians) for p in few_left)
    found = timed(lambda: bounds(replace(placed.gaussians, means=placed.gaussians.means.clone())), 1)
    culled = timed(lambda: draw(placed, camera), args.repeat)
    sight = timed(lambda: in_sight([placed], camera, model), args.repeat)
    rig = rig_of(camera, 6)
    together = timed(lambda: draw(placed, rig), args.repeat)
    room = sys.modules["render.rasterize"]
    room.in_sight = lambda *_: None  # type: ignore[attr-defined]
    try:
        whole, alone = timed(lambda: draw(placed, camera), args.repeat), timed(lambda: draw(few_left, camera), args.repeat)
        one_by_one = timed(lambda: draw(placed, rig), args.repeat)
    finally:
        room.in_sight = in_sight  # type: ignore[attr-defined]
    print(f"street of {args.splats} splats, {camera.width}x{camera.height}, {torch.get_num_threads()} threads, median ms")
    print(f"  all splats projected              {whole:8.1f}")
    print(f"  culled in clusters                {culled:8.1f}   {culled / whole:5.2f}x, {seen} splats left ({seen / args.splats:.1%})")
    print(f"  those splats alone                {alone:8.1f}   so the cull costs {sight:.1f} a frame, and {found:.0f} once")
    print(f"  rig of {len(rig)}, all projected           {one_by_one:8.1f}")
    print(f"  rig of {len(rig)}, one call                {together:8.1f}   {together / one_by_one:5.2f}x")

    g, camera, model = uniform(100_000)
    everything = timed(lambda: draw(g, camera), args.repeat)
    print(f"uniform-100k, {camera.width}x{camera.height}: all {everything:.1f}")
    for share in (0.5, 0.25, 0.1, 0.03):
        side = math.sqrt(share)
        w, h = round(camera.width * side), round(camera.height * side)
        part = timed(lambda w=w, h=h: draw(g, camera, crop=((camera.width - w) // 2, (camera.height - h) // 2, w, h)), args.repeat)
        print(f"  crop of {share:4.0%} of the pixels         {part:8.1f}   {part / everything:5.2f}x")
    for pixels in (10, 100, 1000):
        mask = torch.zeros(camera.height * camera.width, dtype=torch.bool)
        mask[torch.randperm(len(mask), generator=torch.Generator().manual_seed(0))[:pixels]] = True
        mask = mask.view(camera.height, camera.width)
        part = timed(lambda mask=mask: draw(g, camera, mask=mask), args.repeat)
        print(f"  mask of {pixels:4} pixels               {part:8.1f}   {part / everything:5.2f}x")


if __name__ == "__main__":
    main()
