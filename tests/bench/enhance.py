"""Milliseconds against error of the enhancer, for precision, history, tiles and resolution.

    python -m tests.bench.enhance [--size 640x360] [--size 1024x576] [--repeat 9] [--clock cpu] [--device cuda] [--plot enhance.png]

The last of twelve frames of the bundled drive, shot two metres to the left with two inserted cars. The error is to the frame that the same
weights give in float32, with all tiles and all of the history, in levels of 255. All rows but "as loaded" have the network repair the
frame, whatever its weights say of that.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch.nn import functional as F

from enhance.demo import CAMERA, DATA, MOVING, PARKED, SHIFT
from enhance.enhancer import Enhancer, Memory
from enhance.network.precision import has_bfloat16
from render import render_clip
from render.frame_types import Frame
from scenes import Databank, Scene, load
from scenes.insert import insert
from scenes.placement import parse_placement
from tests.bench.measure import CLOCKS, in_turns
from tests.bench.plot import Chart, save

FRAMES = 12
"""By the last of them all objects have been looked at as often as they are at first."""
SHARES = (0.5, 0.75)
READS = tuple(name for name in Enhancer.reads if name != "reference")


def clip(width: int, height: int, device: str) -> list[Frame]:
    """The frames, with what the enhancer reads and need."""
    scene = load(DATA / "drive002")
    assert isinstance(scene, Scene)
    times = scene.frame_times(CAMERA).tolist()[:FRAMES]
    for text in (PARKED, MOVING):
        placement = parse_placement(text)
        scene = insert(scene, Databank(DATA / "databank").load(placement.asset), placement, times[0]).scene
    return list(render_clip(scene.to(device), CAMERA, SHIFT, times, width, height, outputs=("rgb", "need", *READS)))


def without_need(frame: Frame) -> Frame:
    return replace(frame, need=None)


def inserted_only(frame: Frame) -> Frame:
    """As if only actors needed anything: what an insertion into a recorded video is."""
    assert frame.instance is not None
    return replace(frame, need=(frame.instance > 0).float())


def nothing(frame: Frame) -> Frame:
    assert frame.instance is not None
    return replace(frame, need=torch.zeros(frame.instance.shape))


def stepping(enhancer: Enhancer, frames: list[Frame], given: Callable[[Frame], Frame]) -> Callable[[], torch.Tensor]:
    """The last frame's step, after those before it."""
    memory: Memory | None = None
    for frame in frames[:-1]:
        _, memory = enhancer.step(without_need(frame), memory)
    last = given(frames[-1])
    return lambda: enhancer.step(last, memory)[0]


def shrunken(enhancer: Enhancer, frames: list[Frame], share: float) -> Callable[[], torch.Tensor]:
    """The change that is made to a smaller frame, enlarged."""
    small = [_shrunk(f, share) for f in frames]
    step, rgb, full = stepping(enhancer, small, without_need), small[-1].rgb, frames[-1].rgb
    assert rgb is not None and full is not None

    def work() -> torch.Tensor:
        change = (step() - rgb.clamp(0, 1)).permute(2, 0, 1)[None]
        return full.clamp(0, 1) + F.interpolate(change, full.shape[:2], mode="bilinear", align_corners=False)[0].permute(1, 2, 0)

    return work


def _shrunk(frame: Frame, share: float) -> Frame:
    assert frame.rgb is not None and frame.instance is not None
    size = [round(s * share) for s in frame.rgb.shape[:2]]
    rgb = F.interpolate(frame.rgb.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0).contiguous()
    instance = F.interpolate(frame.instance[None, None].float(), size)[0, 0].int()
    flow = frame.flow_prev
    if flow is not None:
        flow = F.interpolate(flow.permute(2, 0, 1)[None], size)[0].permute(1, 2, 0) * share
    return Frame(frame.camera, rgb=rgb, instance=instance, flow_prev=flow)


def works(frames: list[Frame], weights: str, device: str) -> dict[tuple[str, str], Callable[[], torch.Tensor]]:
    """What is compared, by knob and setting; the first is the reference."""
    exact = Enhancer.load(weights, device, bfloat16=False, repair=True)
    usual = Enhancer.load(weights, device, repair=True)
    made = {("precision", "float32"): stepping(exact, frames, without_need)}
    if has_bfloat16(usual.device):
        made["precision", "bfloat16"] = stepping(usual, frames, without_need)
    for k in range(usual.history, -1, -1):
        made["history", f"{k} frames"] = stepping(Enhancer.load(weights, device, history=k, repair=True), frames, without_need)
    made["network", "as loaded"] = stepping(Enhancer.load(weights, device), frames, without_need)
    tiles: dict[str, Callable[[Frame], Frame]] = {"all": without_need, "need, as rendered": lambda f: f, "actors": inserted_only}
    for name, given in (tiles | {"none": nothing}).items():
        made["tiles", name] = stepping(usual, frames, given)
    for share in SHARES:
        made["resolution", f"{share:g} of the width"] = shrunken(usual, frames, share)
    return made


def rows(width: int, height: int, weights: str, repeat: int, clock: str, device: str) -> list[dict]:
    made = works(clip(width, height, device), weights, device)
    ms = in_turns({" ".join(key): work for key, work in made.items()}, repeat, clock)
    reference = next(iter(made.values()))()
    found = []
    for (knob, setting), work in made.items():
        error = 255 * (work() - reference).abs()
        row = {"size": f"{width}x{height}", "knob": knob, "setting": setting, "ms": ms[f"{knob} {setting}"]}
        found.append(row | {"mean": float(error.mean()), "p99.9": float(error.flatten().sort().values[int(0.999 * error.numel())])})
    return found


def table(found: list[dict]) -> str:
    lines = ["| size | knob | setting | ms a frame | mean error, levels | 99.9th percentile |", "|---|---|---|---|---|---|"]
    for r in found:
        cells = (r["size"], r["knob"], r["setting"], f"{r['ms']:.1f}", f"{r['mean']:.3f}", f"{r['p99.9']:.2f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def charts(found: list[dict]) -> list[Chart]:
    made: dict[str, Chart] = {}
    for r in found:
        chart = made.setdefault(r["size"], Chart(f"enhancer, {r['size']}", "ms a frame", "mean error, levels of 255"))
        chart.lines.setdefault(r["knob"], []).append((r["ms"], r["mean"]))
    return list(made.values())


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.enhance", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--size", action="append", help="as 640x360, which is the default; may be repeated")
    parser.add_argument("--weights", default="builtin")
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--clock", choices=CLOCKS, default="wall", help="cpu: of all threads together, for a busy machine")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found = []
    for size in args.size or ["640x360"]:
        width, height = (int(v) for v in size.split("x"))
        found += rows(width, height, args.weights, args.repeat, args.clock, args.device)
    print(f"{args.device}, {torch.get_num_threads()} threads, median ms ({args.clock})\n\n{table(found)}")
    if args.json:
        args.json.write_text(json.dumps(found, indent=1))
    if args.plot:
        save(charts(found), args.plot)


if __name__ == "__main__":
    main()
