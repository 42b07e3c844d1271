"""What was skipped: milliseconds with and without each skip, on scenes where there is something to skip.

    python -m tests.bench.skips [--repeat 9] [--clock cpu]

`SKIPS` makes, by name, the frame as it is drawn and the frame with the work done all the same; `tests/render/test_skips.py` holds their
pictures against each other.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from unittest.mock import patch

import torch

from render import Frame, RenderConfig, rasterize, render_frame
from scenes import Placed, Scene, Sky, Trajectory
from scenes.poses import translation
from tests.bench.measure import CLOCKS, in_turns
from tests.bench.presets import Preset, random_splats, street, uniform

Pair = tuple[Callable[[], Frame], Callable[[], Frame]]
SKIPS: dict[str, Callable[[int], Pair]] = {}


def skip(make: Callable[[int], Pair]) -> Callable[[int], Pair]:
    SKIPS[make.__name__.replace("_", " ")] = make
    return make


def _flat(n: int) -> Preset:
    """As dense as uniform-100k: `n` splats on an image of as many pixels as go with them."""
    side = max(16, int((n * 5.2) ** 0.5) // 16 * 16)
    g, camera, model = uniform(n, side, side)
    return Preset([Placed(g, torch.eye(4, dtype=torch.float64))], camera, model)


def _draw(p: Preset, outputs=("rgb",), **more) -> Callable[[], Frame]:
    return lambda: rasterize(p.placed, p.camera, outputs, model=p.model, **more)


def _without(name: str, instead, work: Callable[[], Frame]) -> Callable[[], Frame]:
    """`work` with a name of render/rasterize.py or render/frame.py replaced."""
    module, _, attribute = name.rpartition(".")

    def run() -> Frame:
        with patch.object(sys.modules[module], attribute, instead):
            return work()

    return run


@skip
def outputs_that_were_not_asked_for(n: int) -> Pair:
    p = _flat(n)
    return _draw(p), _draw(p, ("rgb", "depth", "median_depth", "instance", "normal"))


@skip
def what_gradients_would_need(n: int) -> Pair:
    p = _flat(n)
    leaves = [replace(x, gaussians=x.gaussians.map(lambda t: t.clone().requires_grad_())) for x in p.placed]
    return _draw(p), _draw(replace(p, placed=leaves))


@skip
def harmonics_that_are_zero(n: int) -> Pair:
    p = _flat(n)
    padded = replace(p, placed=[replace(x, gaussians=x.gaussians.with_sh_count(16)) for x in p.placed])
    return _draw(padded), _without("render.rasterize.without_zero_bands", lambda g: g, _draw(padded))


@skip
def actors_out_of_view(n: int) -> Pair:
    p = _flat(n)
    behind = [Placed(random_splats(n // 40, i), translation(3.0 * i, 0, -20), instance=i + 1) for i in range(40)]
    crowd = replace(p, placed=[*p.placed, *behind])
    return _draw(crowd), _without("render.rasterize.in_sight", lambda *_: None, _draw(crowd))


@skip
def clusters_out_of_view(n: int) -> Pair:
    p = street(10 * n)
    return _draw(p), _without("render.rasterize.in_sight", lambda *_: None, _draw(p))


@skip
def a_shutter_that_does_not_move(n: int) -> Pair:
    p = replace(_flat(n), model=replace(_flat(1).model, projection="ut"))
    rolling = replace(p.camera, shutter="rows", world_from_cam_end=p.camera.world_from_cam)
    return _draw(p), _draw(replace(p, camera=rolling))


@skip
def a_sky_behind_everything(n: int) -> Pair:
    """Looked up only where light passes."""
    p = _flat(n)
    sky = Sky(torch.rand(64, 128, 3, generator=torch.Generator().manual_seed(0)))
    still = Trajectory(torch.tensor([0, 1_000_000]), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1))
    scene = Scene(p.placed[0], (), sky, still, {}, p.model)

    def work() -> Frame:
        return render_frame(scene, p.camera, shadows=False)

    return work, _without("render.sky.SKY_SHOWS", -1.0, work)


@skip
def light_that_no_longer_passes(n: int) -> Pair:
    """Rows and tiles end when they are dark, 1e-4 from what all splats would give."""
    p = _flat(n)
    opaque = [replace(x, gaussians=replace(x.gaussians, logit_opacities=x.gaussians.logit_opacities + 2)) for x in p.placed]
    p = replace(p, placed=opaque)
    return _draw(p), _draw(p, config=RenderConfig(termination=0))


@skip
def pixels_that_were_not_asked_for(n: int) -> Pair:
    """A quarter of the picture's width and height, and the whole cut to it."""
    p = _flat(n)
    x, y, w, h = p.camera.width // 3, p.camera.height // 3, p.camera.width // 4, p.camera.height // 4

    def whole() -> Frame:
        frame = _draw(p)()
        assert frame.rgb is not None
        return replace(frame, rgb=frame.rgb[y : y + h, x : x + w])

    return _draw(p, crop=(x, y, w, h)), whole


def table(n: int, repeat: int, clock: str) -> str:
    lines = ["| skipped | with, ms | without, ms |", "|---|---|---|"]
    for name, make in SKIPS.items():
        skipping, doing = make(n)
        ms = in_turns({"with": skipping, "without": doing}, repeat, clock)
        lines.append(f"| {name} | {ms['with']:.1f} | {ms['without']:.1f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.skips", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--splats", type=int, default=100_000)
    parser.add_argument("--clock", choices=CLOCKS, default="wall", help="cpu: of all threads together, for a busy machine")
    args = parser.parse_args()
    print(f"{torch.get_num_threads()} threads, {args.splats} splats, median ms ({args.clock})\n")
    print(table(args.splats, args.repeat, args.clock))


if __name__ == "__main__":
    main()
