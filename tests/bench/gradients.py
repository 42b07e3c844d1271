"""How near every gradient comes to the float64 oracle's, at seeds that no test knows: tensors, those beyond the tolerance, the worst.

    python -m tests.bench.gradients [--seeds 100 106]

The tolerance is the design page's: 1e-3 of the reference plus 1e-6 of its largest entry. Scenes are the tests': clouds, needles and
pancakes, splats beside the camera, every lens, moving shutters, rays and order by pixel. A tensor is a field of an instance, a pose, an
end pose or a lens.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch

from scenes import SplatModel
from tests.render import test_lenses as lenses
from tests.render import test_rasterize as pinhole
from tests.render import test_rays as rays
from tests.render.test_shutter import FISHEYE, PINHOLE, crash, driven, traffic

Named = Iterator[tuple[str, torch.Tensor, torch.Tensor]]
SHUTTERS = [
    (PINHOLE, "rows", traffic),
    (PINHOLE, "columns", crash),
    (FISHEYE, "rows", crash),
    (lenses.LENSES["opencv"], "columns", crash),
    (lenses.LENSES["ftheta"], "columns", traffic),
    (lenses.LENSES["equirectangular"], "rows", traffic),
    (lenses.LENSES["orthographic"], "columns", traffic),
]


def through_a_pinhole(seed: int) -> Named:
    for make in pinhole.SCENES:
        for model in pinhole.MODELS:
            yield from pinhole.gradients_of_both(make(seed), model)


def through_every_lens(seed: int) -> Named:
    for lens in lenses.LENSES.values():
        for make, model in lenses.SCENES:
            yield from lenses.gradients(make(seed), lenses.camera_of(lens), model)


def through_moving_shutters(seed: int) -> Named:
    for lens, shutter, make in SHUTTERS:
        yield from lenses.gradients(make(seed), driven(lens, shutter), SplatModel(antialias=shutter == "rows"))


def along_rays(seed: int) -> Named:
    for model, order in rays.WAYS.values():
        for make in (pinhole.two_instances, pinhole.needles_and_pancakes):
            yield from rays.gradients_of_both(make(seed), pinhole.CAMERA, model, order)
    for camera in rays.EYES.values():
        moves = camera.shutter != "global"
        placed = traffic(seed) if moves else lenses.around(seed)
        yield from rays.gradients_of_both(placed, camera, replace(rays.RAY, antialias=moves), "pixel")


WAYS: tuple[Callable[[int], Named], ...] = (through_a_pinhole, through_every_lens, through_moving_shutters, along_rays)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs=2, default=(100, 106), metavar=("FIRST", "END"))
    first, end = parser.parse_args().seeds
    print(f"seeds {first} to {end - 1}\n\n| | tensors | beyond the tolerance | worst, in tolerances | of |", flush=True)
    print("|---|---|---|---|---|", flush=True)
    for way in WAYS:
        found = [
            (float(pinhole.of_tolerance(mine, ref).max()), f"{name}, seed {seed}")
            for seed in range(first, end)
            for name, mine, ref in way(seed)
        ]
        worst, of = max(found)
        print(f"| {way.__name__.replace('_', ' ')} | {len(found)} | {sum(s > 1 for s, _ in found)} | {worst:.2f} | {of} |", flush=True)


if __name__ == "__main__":
    main()
