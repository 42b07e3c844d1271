"""Milliseconds of a whole frame, projection to image, beside the prototype's composite kernels on the same splats, in one run.

    python -m tests.bench.speed [--splats 100000] [--size 960x544] [--repeat 9] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

import torch

from render import RenderConfig, rasterize
from tests.bench.presets import load_prototype, uniform


def timed(work, repeat: int) -> float:
    """Median milliseconds of `work()` after one warm-up."""
    work()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        work()
        times.append(1000 * (time.perf_counter() - start))
    return statistics.median(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, default=100_000)
    parser.add_argument("--size", default="960x544")
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--json", help="write the table here as well")
    args = parser.parse_args()
    width, height = (int(v) for v in args.size.split("x"))
    threads = torch.get_num_threads()

    gaussians, camera, model = uniform(args.splats, width, height)
    leaves = gaussians.map(lambda t: t.clone().requires_grad_())
    weights = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(0))

    def train_step():
        frame = rasterize(leaves, camera, outputs=("rgb",), model=model)
        (frame.rgb * weights).sum().backward()

    ours = {
        "forward": lambda: rasterize(gaussians, camera, outputs=("rgb",), model=model),
        "forward + backward": train_step,
        "forward, unscented": lambda: rasterize(gaussians, camera, outputs=("rgb",)),
        "forward, depth and instance": lambda: rasterize(gaussians, camera, outputs=("rgb", "depth", "instance"), model=model),
        "forward, no termination": lambda: rasterize(gaussians, camera, outputs=("rgb",), model=model, config=RenderConfig(termination=0)),
    }

    lanes = load_prototype()
    tiles = lanes.Tiles(args.splats, width, height)
    tiles.run(lanes.forward, 1)
    tiles.set_grad(torch.nn.functional.pad(weights, (0, 0, 0, tiles.tx * 16 - width, 0, tiles.ty * 16 - height)).numpy())
    kernels = {"plain": lanes.plain, "forward": lanes.forward, "backward": lanes.backward}

    # rounds alternate between the two, so that a change of the machine's speed meets both alike
    times: dict[str, list[float]] = {}
    for _ in range(3):
        for name, kernel in kernels.items():
            repeat = 1 if name == "plain" else args.repeat
            times.setdefault(f"prototype {name}", []).append(timed(lambda k=kernel: tiles.run(k, threads), repeat))
        for name, work in ours.items():
            times.setdefault(name, []).append(timed(work, args.repeat))
    ms = {name: statistics.median(values) for name, values in times.items()}
    forward, both = ms["prototype forward"], ms["prototype forward"] + ms["prototype backward"]
    print(f"{args.splats} splats, {width}x{height}, {threads} threads, median ms (the prototype composites only: {len(tiles.ids)} entries)")
    for name, value in ms.items():
        base = both if "backward" in name else forward
        print(f"  {name:30} {value:9.1f} ms   {value / base:5.2f}x the prototype's {'forward + backward' if base == both else 'forward'}")
    if args.json:
        with open(args.json, "w") as f:
            json.dump({"splats": args.splats, "width": width, "height": height, "threads": threads, "ms": ms}, f, indent=1)


if __name__ == "__main__":
    main()
