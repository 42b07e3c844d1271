"""How much better is it, on pairs never trained on? `python -m enhance.evaluate PAIRS` prints the table, identity first."""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from enhance.clip import telling
from enhance.correcting.grade import Grade, Graded
from enhance.drift import KEPT, drift, drift_text, of_video
from enhance.enhancer import Enhancer
from enhance.metrics import Features, feature_distance, interval, region_ssim, sharpness, warp_error
from enhance.network.weights_file import BUILTIN, load_net
from enhance.pairs.shards import KINDS, RENDERED, PairSet, Shard, Window
from enhance.step import Steps, frame_of
from render.compare import psnr, ssim
from render.frame_types import Frame
from scenes.opening import check_device
from scenes.spread import spread

HIGHEST = 60.0
"""PSNR in dB that a frame counts at most in a mean: some frames come back bit by bit."""

EVERY = 3
"""Every how many frames the measures are taken that cost more than the enhancer: SSIM, features, sharpness."""

SMALLEST = 200
"""Pixels that a region must have to be measured by itself."""

TOLD, PUT_IN = "ours + instances", "ours + what was put in"
METHODS = ("identity", "ours", TOLD)
"""TOLD is told all actors; PUT_IN, of kinds that change some, those alone, as `render --enhance` does with what was inserted."""
ALONE, ALL_TOLD, PUT_IN_TOLD = "references alone", "ours + instances + references", "ours + what was put in + references"
PHOTOS = (ALONE, ALL_TOLD, PUT_IN_TOLD)
"""Where a rendered scene, or an asset put back, has photos: what those say of the frame, and that enhanced."""
GRADED, WHOLE_FRAMES = "ours, graded like other photos", ("isp_frame", "clean")
"""Of these kinds, whole frames in other colours and right ones: given the colours of what the same camera's other clips should be."""


@dataclass(frozen=True)
class Row:
    """One method on one kind of damage.

    clips         by clip and measure the mean over its frames, NaN where a clip has no region: "region" and "frame", PSNR in dB inside
                  the damaged region and over the frame, at most 60 (half an 8-bit level) unless all are equal; "ssim in the region",
                  "ssim"; "features" in the region (`feature_distance`); "warp error" in 8-bit levels along exact flow over visible
                  pixels; "sharpness" in the region, Laplacian variance to the target's
    milliseconds  a frame, the median
    """

    kind: str
    method: str
    clips: dict[str, list[float]] = field(repr=False)
    milliseconds: float
    frames: int

    def mean(self, measure: str) -> float:
        """Over the clips that have it; NaN where none has."""
        values = [v for v in self.clips[measure] if not np.isnan(v)]
        if not values:
            return float("nan")
        if measure in ("region", "frame") and not np.isinf(values).all():
            values = [min(v, HIGHEST) for v in values]
        return float(np.mean(values))

    def gain(self, identity: Row, measure: str = "region") -> list[float]:
        """By clip, how much higher a measure is than the identity's."""
        both = zip(self.clips[measure], identity.clips[measure], strict=True)
        return [min(a, HIGHEST) - min(b, HIGHEST) for a, b in both]


def evaluate(
    pairs: PairSet,
    enhancer: Steps,
    split: str = "held out",
    limit: int | None = None,
    progress: Callable[[str], None] | None = None,
    beside: Mapping[str, Steps] | None = None,
) -> list[Row]:
    """Rows for identity, the enhancer on plain RGB with flow, and the enhancer told the instances too, for each kind there is; of those
    that change some instances for the enhancer told these alone; where photos say something, for that, and the enhancer told that and the
    instances; of whole pictures in other colours, and of right ones, for the enhancer of graded frames; then for those `beside` it by name,
    told the instances too.

    For clean frames the reference is the frame itself. Features are those of the shipped autoencoder, whatever the enhancer, so that
    weights are measured alike. `limit` is the most clips of a kind, spread over all. ValueError where nothing is held out.
    """
    features, rows, others = shipped_features(enhancer.device), [], dict(beside or {})
    of_photos = enhancer.for_photos() if isinstance(enhancer, Enhancer) else enhancer
    for kind in KINDS:
        shards = pairs.of(kind, split)
        shards = shards if limit is None else spread(shards, limit)
        put_in = any("instances" in s.meta for s in shards)
        graded = (GRADED,) if kind in WHOLE_FRAMES and all(_siblings(s, pairs, split) for s in shards) else ()
        photos = (ALONE, PUT_IN_TOLD if put_in else ALL_TOLD) if kind in RENDERED or any(s.referenced for s in shards) else ()
        mine = enhancer if kind in RENDERED else of_photos
        for method in (*METHODS, *((PUT_IN,) if put_in else ()), *graded, *photos, *others) if shards else ():
            if progress is not None:
                progress(f"{kind}, {method}: {len(shards)} clips")
            grades = [_grade_of(_siblings(s, pairs, split)) for s in shards] if method == GRADED else None
            rows.append(measured(kind, method, shards, others.get(method, mine), features, grades))
    if not rows:
        fix = (
            "make pairs of another camera too, or of photos (sidestep pairs --photos), or look at those that were trained on, --split train"
        )
        raise ValueError(f'the pairs hold no clip of split "{split}"; {fix}')
    return rows


def _siblings(shard: Shard, pairs: PairSet, split: str) -> list[Shard]:
    """The same camera's other clips of a kind."""
    return [s for s in pairs.of(shard.meta["kind"], split) if s.meta.get("camera") == shard.meta.get("camera") and s.path != shard.path]


def _grade_of(shards: Sequence[Shard]) -> Grade:
    """Of what clips' middle frames should be."""
    return Grade([shard.window(shard.frames // 2, 1).target[0].permute(1, 2, 0) for shard in shards])


MEASURES = ("region", "frame", "ssim in the region", "ssim", "features", "warp error", "sharpness")


def shipped_features(device: str | torch.device = "cpu") -> Features:
    """Those of the shipped autoencoder, computed on a device from pictures on the CPU, where they come back to."""
    encoder = load_net(BUILTIN)[0].encoder.eval().requires_grad_(False).to(device)
    return lambda rgb: [x.cpu() for x in encoder.features(rgb.to(device))[:2]]


def measured(
    kind: str, method: str, shards: Sequence[Shard], enhancer: Steps, features: Features, grades: Sequence[Grade] | None = None
) -> Row:
    """The row of one method, of METHODS, GRADED, PHOTOS or an enhancer of another name, told the instances, on clips of a kind. grades: of
    GRADED, a clip's each."""
    clips: dict[str, list[float]] = {m: [] for m in MEASURES}
    times: list[float] = []
    for i, shard in enumerate(shards):
        found: dict[str, list[float]] = defaultdict(list)
        steps = enhancer if grades is None else Graded(enhancer, grades[i])
        window = shard.window()
        previous: torch.Tensor | None = None
        memory: Any = None
        for t in range(shard.frames):
            frame = _frame(window, t, told=method not in (*METHODS, GRADED) or method == TOLD, referenced=method in PHOTOS)
            if method in (PUT_IN, PUT_IN_TOLD):
                frame = telling(frame, shard.meta.get("instances", ()))
            start = time.perf_counter()
            if method == "identity":
                better = window.input[t].permute(1, 2, 0)
            elif method == ALONE:
                better = torch.lerp(window.input[t], window.reference[t], window.trust[t]).permute(1, 2, 0)
            else:
                better, memory = steps.step(frame, memory)
            better = better.cpu()  # which waits for a GPU: only then was the time all spent
            times.append(1000 * (time.perf_counter() - start))
            _measure(found, better, window, t, features)
            error = None if previous is None else warp_error(better, previous, window.flow[t], window.visible[t])
            if error is not None:
                found["warp error"].append(error)
            previous = better
        for measure, values in clips.items():
            values.append(_mean(found[measure], measure))
    return Row(kind, method, clips, float(np.median(times)), len(times))


def _measure(found: dict[str, list[float]], better: torch.Tensor, window: Window, t: int, features: Features) -> None:
    target = window.target[t].permute(1, 2, 0)
    region = window.region[t, 0] > 0.5
    found["frame"].append(psnr(better, target))
    large = int(region.sum()) >= SMALLEST
    if large:
        found["region"].append(psnr(better, target, region))
    if t % EVERY != min(EVERY, len(window.input)) - 1:
        return
    found["ssim"].append(ssim(better, target))
    if not large:
        return
    found["ssim in the region"].append(region_ssim(better, target, region))
    found["features"].append(feature_distance(better, target, region, features))
    found["sharpness"].append(sharpness(better, region) / max(sharpness(target, region), 1e-9))


def _mean(values: list[float], measure: str) -> float:
    if not values:
        return float("nan")
    if measure in ("region", "frame") and not np.isinf(values).all():
        values = [min(v, HIGHEST) for v in values]
    return float(np.mean(values))


def _frame(window: Window, t: int, told: bool, referenced: bool) -> Frame:
    rgb = window.input[t].permute(1, 2, 0).contiguous()
    frame = replace(frame_of(rgb, window.instance[t, 0] if told else None), flow_prev=window.flow[t].permute(1, 2, 0) if t else None)
    if not referenced:
        return frame
    return replace(frame, reference=window.reference[t].permute(1, 2, 0), trust=window.trust[t, 0])


def _told(shards: Sequence[Shard]) -> list[Frame]:
    """The first frames of one camera's clips, told their objects; without flow, which is only known one way."""
    mine = [s for s in shards if s.meta.get("camera") == shards[0].meta.get("camera")]
    frames = (_frame(shard.window(t, 1), 0, told=True, referenced=False) for shard in mine for t in range(shard.frames))
    return [frame for frame, _ in zip(frames, range(KEPT), strict=False)]


def table(rows: Sequence[Row]) -> str:
    """The rows in Markdown; gains over identity in the region with their 95 percent interval over clips, where there are
    several."""
    measures = ["PSNR in the region", "gain, dB (95 %)", "PSNR of the frame", "SSIM region / frame", "features", "warp error", "sharpness"]
    names = ["damage", "method", *measures, "ms"]
    lines = [f"| {' | '.join(names)} |", "|" + len(names) * "---|"]
    identity: dict[str, Row] = {r.kind: r for r in rows if r.method == "identity"}
    for r in rows:
        cells = [_written(r.mean("region")), "-", _written(r.mean("frame"))]
        if r.method != "identity" and r.kind in identity:
            gains = r.gain(identity[r.kind], "region")
            low, high = interval(gains)
            if np.isfinite(gains).any():  # of a single clip without an interval
                cells[1] = f"{np.nanmean(gains):+.2f}" + (f" ({low:+.2f} to {high:+.2f})" if np.isfinite(low) else "")
        cells.append(f"{_written(r.mean('ssim in the region'), 3)} / {_written(r.mean('ssim'), 3)}")
        cells += [_written(r.mean("features"), 4), _written(r.mean("warp error")), _written(r.mean("sharpness"))]
        spent = "-" if r.method == "identity" else f"{r.milliseconds:.0f}"
        lines.append(f"| {r.kind} | {r.method} | {' | '.join(cells)} | {spent} |")
    return "\n".join(lines)


def _written(value: float, digits: int = 2) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "equal" if value > 0 else "-"


def _count(word: str) -> int:
    """A number of clips; argparse says what was wrong with the word."""
    if not word.isdecimal() or int(word) == 0:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1, got {word}")
    return int(word)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m enhance.evaluate", description=__doc__)
    parser.add_argument("pairs", type=Path, nargs="+", help="folders that sidestep pairs made")
    parser.add_argument("--weights", default="builtin", help="builtin, a file that sidestep train wrote, or a public model's")
    parser.add_argument("--beside", default=[], action="append", help="a public model's checkpoint as a further row; may be repeated")
    parser.add_argument("--limit", type=_count, default=None, help="most clips of a kind")
    parser.add_argument("--split", default="held out", choices=("held out", "train"))
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"), help="where to enhance")
    parser.add_argument(
        "--rollout", type=Path, help="a video on which, and on clean frames of the pairs, drift over 500 frames back and forth is measured"
    )
    options = parser.parse_args(arguments)
    try:
        check_device(options.device)
        rollout = of_video(options.rollout) if options.rollout else []  # now: a wrong one must not cost the wait for the table
        pairs, enhancer = PairSet(*options.pairs), Enhancer.load(options.weights, options.device)
        others = {path: Enhancer.load(path, options.device) for path in options.beside}
        beside = {f"{one.about.get('model', 'weights')} ({path})": one for path, one in others.items()}
        told = _told(pairs.of("clean", options.split)) if rollout else []
        if rollout and len(told) < 2:
            raise ValueError(f'--rollout needs at least two frames of clean pairs of split "{options.split}" too, beside the video')
        rows = evaluate(pairs, enhancer, options.split, options.limit, lambda line: print(line, file=sys.stderr), beside)
        print(table(rows))
        if rollout:
            print(drift_text(options.rollout.name, drift(enhancer, rollout)))
            print(drift_text("clean frames told their objects", drift(enhancer, told)))
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
