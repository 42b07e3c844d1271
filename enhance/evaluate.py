"""How much better is it, on pairs never trained on? `python -m enhance.evaluate PAIRS` prints the table, identity first."""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from enhance.enhancer import Enhancer, Memory
from enhance.shards import KINDS, PairSet, Shard, Window
from render.compare import psnr
from render.frame_types import Frame
from render.warp import warp
from scenes.camera import Camera
from scenes.lenses import Pinhole

HIGHEST = 60.0
"""PSNR in dB that a frame counts at most in a mean: some frames come back bit by bit."""


@dataclass(frozen=True)
class Row:
    """One method on one kind of damage, means over frames: PSNR in dB inside the damaged region and over the frame (at most 60, which
    is half an 8-bit level, unless all frames are equal), warp error in 8-bit levels (mean absolute difference to the previous frame
    moved along exact flow, on visible pixels), milliseconds a frame."""

    kind: str
    method: str
    region: float
    frame: float
    warp_error: float
    milliseconds: float
    frames: int


def evaluate(
    pairs: PairSet,
    enhancer: Enhancer,
    split: str = "held out",
    limit: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> list[Row]:
    """Rows for identity, the enhancer on plain RGB with flow, and the enhancer told the instances too, for each kind there is.

    For clean frames the reference is the frame itself. `limit` is the most clips of a kind. ValueError where nothing is held out.
    """
    rows = []
    for kind in KINDS:
        shards = pairs.of(kind, split)[:limit]
        for method in ("identity", "ours", "ours + instances") if shards else ():
            if progress is not None:
                progress(f"{kind}, {method}: {len(shards)} clips")
            rows.append(_row(kind, method, shards, enhancer))
    if not rows:
        raise ValueError(f'the pairs hold no clip of split "{split}"; make pairs of the held-out camera too')
    return rows


def _row(kind: str, method: str, shards: Sequence[Shard], enhancer: Enhancer) -> Row:
    found: dict[str, list[float]] = defaultdict(list)
    for shard in shards:
        window = shard.window()
        previous: torch.Tensor | None = None
        memory: Memory | None = None
        for t in range(shard.frames):
            frame = _frame(window, t, told=method == "ours + instances")
            start = time.perf_counter()
            if method == "identity":
                better = window.input[t].permute(1, 2, 0)
            else:
                better, memory = enhancer.step(frame, memory)
            found["milliseconds"].append(1000 * (time.perf_counter() - start))
            target = window.target[t].permute(1, 2, 0)
            region = window.region[t, 0] > 0.5
            if region.any():
                found["region"].append(psnr(better, target, region))
            found["frame"].append(psnr(better, target))
            if previous is not None:
                found["warp_error"] += _warp_error(better, previous, window, t)
            previous = better
    means = {k: float(np.mean(found[k])) if found[k] else float("nan") for k in ("region", "frame", "warp_error")}
    for name in ("region", "frame"):
        if np.isinf(means[name]) and not np.isinf(found[name]).all():
            means[name] = float(np.minimum(found[name], HIGHEST).mean())
    return Row(kind, method, **means, milliseconds=float(np.median(found["milliseconds"])), frames=len(found["frame"]))


def _frame(window: Window, t: int, told: bool) -> Frame:
    rgb = window.input[t].permute(1, 2, 0).contiguous()
    height, width = rgb.shape[:2]
    somewhere = Camera(Pinhole(1.0, 1.0, width / 2, height / 2), width, height, torch.eye(4, dtype=torch.float64))
    flow = window.flow[t].permute(1, 2, 0) if t else None
    return Frame(somewhere, rgb=rgb, flow_prev=flow, instance=window.instance[t, 0] if told else None)


def _warp_error(better: torch.Tensor, previous: torch.Tensor, window: Window, t: int) -> list[float]:
    moved, inside = warp(previous.permute(2, 0, 1)[None], window.flow[t][None])
    seen = (window.visible[t] * inside[0])[0] > 0.5
    if not seen.any():
        return []
    return [255 * float((better - moved[0].permute(1, 2, 0)).abs().mean(-1)[seen].mean())]


def table(rows: Sequence[Row]) -> str:
    """The rows in Markdown."""
    lines = [
        "| damage | method | PSNR in the region, dB | PSNR of the frame, dB | warp error, levels | ms a frame | frames |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        region, frame, error = (f"{x:.2f}" if np.isfinite(x) else "equal" if x > 0 else "-" for x in (r.region, r.frame, r.warp_error))
        spent = "-" if r.method == "identity" else f"{r.milliseconds:.0f}"
        lines.append(f"| {r.kind} | {r.method} | {region} | {frame} | {error} | {spent} | {r.frames} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m enhance.evaluate", description=__doc__)
    parser.add_argument("pairs", type=Path, nargs="+", help="folders that sidestep pairs made")
    parser.add_argument("--weights", default="builtin", help="builtin, or a file that sidestep train wrote")
    parser.add_argument("--limit", type=int, default=None, help="most clips of a kind")
    parser.add_argument("--split", default="held out", choices=("held out", "train"))
    options = parser.parse_args(arguments)
    try:
        pairs = PairSet(*options.pairs)
        rows = evaluate(pairs, Enhancer.load(options.weights), options.split, options.limit, lambda line: print(line, file=sys.stderr))
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
