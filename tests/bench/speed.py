"""Milliseconds of whole frames, projection to image, on every preset, and beside the prototype's kernels on the same splats.

    python -m tests.bench.speed [--only NAME,NAME] [--drive FOLDER] [--lund FOLDER] [--repeat 9] [--clock cpu] [--plot PNG] [--json FILE]

Each preset runs in a process of its own, so that its peak memory is its own. Nothing here asserts a time.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import torch

from render import RenderConfig, rasterize
from render.order import depth_order
from tests.bench.limit import compositing, forward_limit
from tests.bench.measure import CLOCKS, in_turns, lane_rate, peak_memory, timed
from tests.bench.plot import Chart, save
from tests.bench.presets import Missing, Preset, load_prototype, presets, uniform


def measure(name: str, preset: Preset, repeat: int, clock: str) -> dict:
    """One preset's row."""
    threads, camera = torch.get_num_threads(), preset.camera
    leaves = [_leaf(p) for p in preset.placed]
    weights = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(0))

    def forward(**more):
        return rasterize(preset.placed, camera, ("rgb",), model=preset.model, **more)

    def train_step():
        (rasterize(leaves, camera, ("rgb",), model=preset.model).rgb * weights).sum().backward()

    rasterize(uniform(10)[0], camera, ("rgb",), model=preset.model)  # loads the kernels
    memory = peak_memory(forward)
    works = {"forward": forward, "both": train_step}
    if name.startswith("uniform"):
        lanes = load_prototype()
        tiles = lanes.Tiles(len(preset), camera.width, camera.height)
        tiles.run(lanes.forward, 1)
        tiles.set_grad(torch.nn.functional.pad(weights, (0, 0, 0, tiles.tx * 16 - camera.width, 0, tiles.ty * 16 - camera.height)).numpy())
        works |= {f"prototype {k}": lambda k=k: tiles.run(getattr(lanes, k), threads) for k in ("forward", "backward")}
    ms = in_turns(works, repeat, clock)
    if name == "uniform-100k":
        depths = preset.placed[0].gaussians.means[:, 2].contiguous().view(torch.int32)  # as of a camera at the origin
        more = {
            "compositing alone": compositing(preset),
            "depth order alone": lambda: depth_order(depths),
            "unscented": lambda: rasterize(preset.placed, camera, ("rgb",)),
            "depth and instance": lambda: rasterize(preset.placed, camera, ("rgb", "depth", "instance"), model=preset.model),
            "no termination": lambda: forward(config=RenderConfig(termination=0)),
            "max_error 1/64": lambda: forward(config=RenderConfig(max_error=1 / 64)),
            "max_error 1/255": lambda: forward(config=RenderConfig(max_error=1 / 255)),
            "max_error 1/1024": lambda: forward(config=RenderConfig(max_error=1 / 1024)),
            "max_error 1/4096": lambda: forward(config=RenderConfig(max_error=1 / 4096)),
        }
        ms |= in_turns(more, repeat, clock)
        ms["prototype plain"] = timed(lambda: tiles.run(lanes.plain, threads), 1, clock)
    row = {"name": name, "splats": len(preset), "size": f"{camera.width}x{camera.height}", "threads": threads, "ms": ms, "memory": memory}
    if name == "uniform-100k":
        row["limit_ms"] = forward_limit(preset) / lane_rate(threads) * 1000
    return row


def _leaf(placed):
    from dataclasses import replace

    return replace(placed, gaussians=placed.gaussians.map(lambda t: t.clone().requires_grad_()))


def table(rows: list[dict]) -> str:
    """The rows in Markdown; ratios are to the prototype's composite kernels, which do nothing else, on the same splats."""
    lines = [
        "| preset | splats | forward, ms | forward + backward, ms | splats/s | bytes a splat | peak memory, MiB "
        "| forward / prototype | both / prototype | forward / plain |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        if "missing" in r:
            lines.append(f"| {r['name']} | {r['missing']} | | | | | | | | |")
            continue
        ms, n = r["ms"], r["splats"]
        ratios = ["", "", ""]
        if "prototype forward" in ms:
            ratios[0] = f"{ms['forward'] / ms['prototype forward']:.2f}"
            ratios[1] = f"{ms['both'] / (ms['prototype forward'] + ms['prototype backward']):.2f}"
        if "prototype plain" in ms:
            ratios[2] = f"{ms['forward'] / ms['prototype plain']:.3f}"
        lines.append(
            f"| {r['name']} {r['size']} | {n} | {ms['forward']:.1f} | {ms['both']:.1f} | {n / ms['forward'] / 1000:.1f}M "
            f"| {r['memory'] / n:.0f} | {r['memory'] / 2**20:.0f} | {' | '.join(ratios)} |"
        )
    return "\n".join(lines)


def details(row: dict) -> str:
    """What else was measured on uniform-100k, the arithmetic limit included."""
    ms = row["ms"]
    lines = ["| uniform-100k, whole frame | ms | of the prototype's forward |", "|---|---|---|"]
    for name in ms:
        if name != "both":
            lines.append(f"| {name} | {ms[name]:.1f} | {ms[name] / ms['prototype forward']:.2f} |")
    limit = row["limit_ms"]
    reached = ", ".join(f"{name} reaches {100 * limit / ms[name]:.0f}% of it" for name in ("compositing alone", "forward"))
    lines.append(f"| arithmetic limit of compositing: its lane operations over the machine's rate | {limit:.1f} | {reached} |")
    return "\n".join(lines)


def scaling(repeat: int, clock: str) -> list[Chart]:
    """Forward and forward + backward over splats, over pixels, over threads."""
    charts = [Chart(f"Time over {x}", x, "ms", {}) for x in ("splats", "pixels", "threads")]

    def both(chart: Chart, x: float, n: int, width: int, height: int) -> None:
        g, camera, model = uniform(n, width, height)
        leaves = g.map(lambda t: t.clone().requires_grad_())
        forward = timed(lambda: rasterize(g, camera, ("rgb",), model=model), repeat, clock)
        whole = timed(lambda: rasterize(leaves, camera, ("rgb",), model=model).rgb.sum().backward(), repeat, clock)
        chart.lines.setdefault("forward", []).append((x, forward))
        chart.lines.setdefault("forward + backward", []).append((x, whole))

    for n in (1_000, 10_000, 30_000, 100_000, 300_000, 1_000_000):
        both(charts[0], n, n, 960, 544)
    for width, height in ((120, 68), (240, 136), (480, 272), (960, 544), (1920, 1088), (3840, 2160)):
        both(charts[1], width * height, 100_000, width, height)
    most = torch.get_num_threads()
    for threads in range(1, most + 1):
        torch.set_num_threads(threads)
        both(charts[2], threads, 100_000, 960, 544)
    torch.set_num_threads(most)
    return charts


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.speed", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", help="comma-separated names of presets")
    parser.add_argument("--drive", type=Path, help="a scene folder of drive 002; the bundled demo's otherwise")
    parser.add_argument("--lund", type=Path, help="a scene folder of lund")
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--clock", choices=CLOCKS, default="wall", help="cpu: of all threads together, for a busy machine")
    parser.add_argument("--plot", type=Path, help="write the scaling plot here")
    parser.add_argument("--json", type=Path, help="write all rows here")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    args = parser.parse_args()
    makers = presets(args.drive, args.lund)
    if args.worker:
        print(json.dumps(measure(args.worker, makers[args.worker](), args.repeat, args.clock)))
        return
    rows = []
    for name in args.only.split(",") if args.only else makers:
        try:
            makers[name]()
        except Missing as missing:
            rows.append({"name": name, "missing": str(missing)})
            continue
        command = [sys.executable, "-m", "tests.bench.speed", "--worker", name, "--repeat", str(args.repeat), "--clock", args.clock]
        command += [a for flag, folder in (("--drive", args.drive), ("--lund", args.lund)) if folder for a in (flag, str(folder))]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
    print(f"{torch.get_num_threads()} threads, whole frames, median ms ({args.clock}) of {args.repeat}\n\n{table(rows)}\n")
    for row in rows:
        if "limit_ms" in row:
            print(details(row))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))
    if args.plot:
        save(scaling(max(1, args.repeat // 3), args.clock), args.plot, columns=3)


if __name__ == "__main__":
    main()
