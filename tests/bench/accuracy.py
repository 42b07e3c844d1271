"""Milliseconds against error for every knob of the rasterizer, against truth (`tests/oracle.py`), float64 and exact.

    python -m tests.bench.accuracy [--scene cloud|drive] [--size 320x208] [--repeat 9] [--clock cpu] [--plot PNG] [--json FILE]

Each knob is turned alone while the others stay at their most exact, so that its own error shows. Error: the largest of a colour, the
99.9th percentile, PSNR. Nothing here asserts anything.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from unittest.mock import patch

import torch

from render import RenderConfig, rasterize
from render.kernels.rows import EXP
from render.kernels.types import X_REST, Y_REST, Wanted, X, Y
from render.settings import Settings
from scenes import Camera, Pinhole, Placed, SplatModel
from scenes.poses import translation
from tests import oracle
from tests.bench.measure import CLOCKS, timed
from tests.bench.plot import Chart, save
from tests.bench.presets import STILL, Preset, drive, random_splats
from tests.render.test_cuda import keep_forward

EXACT = {"alpha_cutoff": 1e-8, "alpha_max": 1.0, "termination": 0.0}
KNOBS = {
    "cutoff": [{"alpha_cutoff": c} for c in (1 / 16, 1 / 64, 1 / 255, 1 / 1024, 1 / 4096, 1 / 65536)],
    "termination": [{"termination": t} for t in (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)],
    "clamp": [{"alpha_max": a} for a in (0.9, 0.99, 0.999, 0.9999)],
    "max_error": [{"max_error": e} for e in (1 / 16, 1 / 64, 1 / 255, 1 / 1024, 1 / 4096)],
    "defaults": [{}],
}
BANDS = (1, 4, 9)


def cloud(width: int, height: int, count: int = 12_000) -> Preset:
    """All shapes, all opacities, all bands of harmonics, some of it near."""
    g = random_splats(count, 1)
    g = replace(g, log_scales=g.log_scales - 0.9, logit_opacities=3 * g.logit_opacities)
    camera = Camera(Pinhole(0.9 * width, 0.9 * width, width / 2, height / 2), width, height, STILL)
    return Preset([Placed(g, translation(0, 0, 4))], camera, SplatModel())


def errors(picture: torch.Tensor, truth: torch.Tensor) -> dict[str, float]:
    off = (picture.double() - truth).abs()
    return {
        "max": float(off.max()),
        "p99.9": float(off.flatten().kthvalue(math.ceil(0.999 * off.numel())).values),
        "psnr": -10 * math.log10(max(float(off.square().mean()), 1e-20)),
    }


def exact_picture(p: Preset, order: str, **change) -> torch.Tensor:
    return oracle.truth(p.placed, p.camera, replace(p.model, **change), order=order)[0]


def rows(p: Preset, measure: Callable[[Callable[[], object]], float]) -> list[dict]:
    """Every knob's settings: knob, setting, ms, errors."""

    def draw(preset: Preset, config: RenderConfig):
        return lambda: rasterize(preset.placed, preset.camera, ("rgb",), model=preset.model, config=config).rgb

    found: list[dict] = []

    def add(knob: str, setting: str, work, truth: torch.Tensor) -> None:
        found.append({"knob": knob, "setting": setting, "ms": measure(work), **errors(work(), truth)})

    by_centres = exact_picture(p, "tile")
    sorted_exactly = exact_picture(p, "pixel")
    config = RenderConfig(**EXACT)
    orders = any(f.name == "order" for f in fields(RenderConfig))
    add("float32", "all knobs exact, order by centres", draw(p, config), by_centres)
    for knob, settings in KNOBS.items():
        for setting in settings:
            # a budget includes the order, where pixels can be sorted
            whole = "max_error" in setting
            chosen = RenderConfig(**(setting if whole or not setting else EXACT | setting))
            truth = sorted_exactly if whole and orders else by_centres
            add(knob, ", ".join(f"{k} {v:.3g}" for k, v in setting.items()) or "RenderConfig()", draw(p, chosen), truth)
    add("order", "tile", draw(p, config), sorted_exactly)
    if orders:
        add("order", "pixel", draw(p, RenderConfig(**EXACT, order="pixel")), sorted_exactly)
    for count in BANDS:
        fewer = replace(p, placed=[replace(x, gaussians=x.gaussians.with_sh_count(count)) for x in p.placed])
        add("SH degree", f"{math.isqrt(count) - 1} of {math.isqrt(p.placed[0].gaussians.sh.shape[1]) - 1}", draw(fewer, config), by_centres)
    halved = [replace(x, gaussians=replace(x.gaussians, sh=x.gaussians.sh.half().float())) for x in p.placed]
    add("colours", "half precision", draw(replace(p, placed=halved), config), by_centres)
    add(
        "response",
        "ray in place of conic",
        _or_none(draw(replace(p, model=replace(p.model, response="ray")), config), by_centres),
        by_centres,
    )
    with patch.object(oracle, "project_ut", monte_carlo):
        sampled = exact_picture(p, "tile", projection="ut")
    for way in ("ut", "ewa"):
        add("projection", f"{way}, to Monte Carlo", draw(replace(p, model=replace(p.model, projection=way)), config), sampled)
    return found


def _or_none(work, like: torch.Tensor):
    """`work`, or not-a-number where that cannot be drawn yet."""
    try:
        work()
        return work
    except ValueError:
        return lambda: torch.full_like(like, torch.nan)


def monte_carlo(points: torch.Tensor, axes: torch.Tensor, lens: torch.Tensor, width: int, height: int, samples: int = 4000):
    """Pixel means and covariances, also with depth, of samples of each Gaussian, those behind the camera left out: what UT and EWA
    approximate.

    The moments of a perspective Gaussian diverge near the camera plane, so this is a comparison and not the truth.
    """
    dice = torch.Generator().manual_seed(0)
    fx, fy, cx, cy = lens
    normal = torch.randn(samples // 2, 3, generator=dice, dtype=torch.float64)
    normal = torch.cat([normal, -normal])
    means, covariances, with_depth = [], [], []
    for point, axis in zip(points.split(2000), axes.split(2000), strict=True):
        there = point[:, None] + torch.einsum("nij,sj->nsi", axis, normal)
        z = torch.where(there[..., 2] > 0.1 * point[:, None, 2], there[..., 2], torch.nan)
        pixels = torch.stack([fx * there[..., 0] / z + cx, fy * there[..., 1] / z + cy], -1)
        mean = pixels.nanmean(1)
        d = (pixels - mean[:, None]).nan_to_num(0.0)
        seen = z.isfinite().sum(1)
        means.append(mean)
        covariances.append(torch.einsum("nsi,nsj->nij", d, d) / seen[:, None, None])
        with_depth.append(torch.einsum("nsi,ns->ni", d, z.nan_to_num(0.0)) / seen[:, None])
    return torch.cat(means), torch.cat(covariances), torch.cat(with_depth)


def ut_in_pixels(count: int = 20_000) -> dict[str, float]:
    """How far float32 puts a splat's centre at 3840x2160, f = 2000 px, from float64, in pixels: median, 99th percentile, largest."""
    camera = Camera(Pinhole(2000.0, 2000.0, 1920.0, 1080.0), 3840, 2160, STILL)
    g = random_splats(count, 5, sh_count=1, spread=2.0)
    pose = translation(0, 0, 6)
    settings = Settings(camera.width, camera.height, SplatModel(), RenderConfig(), Wanted(), (0,))
    kept, _ = keep_forward(settings, g, pose, camera.lens)
    field = {k: t.detach() for k, t in oracle.to_float64(g).items()}
    points = field["means"] @ pose[:3, :3].T + pose[:3, 3]
    axes = oracle.matrix_from_quat(field["quats"]) * field["log_scales"].exp()[:, None, :]
    mean, *_ = oracle.project_ut(points, axes, camera.lens.params(), camera.width, camera.height)
    drawn = kept.scene.counts > 0
    centres = sum(kept.scene.records[drawn][:, [int(i) for i in part]].double() for part in ((X, Y), (X_REST, Y_REST)))
    off = (centres - mean[drawn]).norm(dim=1).sort().values
    return {"median": float(off[len(off) // 2]), "p99": float(off[int(0.99 * len(off))]), "max": float(off[-1])}


def exp_errors() -> list[dict]:
    """The polynomial of exp(-s), squared q times, on the exponents that q serves: largest error, absolute and of exp(-s) itself."""
    found = []
    for q, cutoff in ((2, 1 / 400), (3, 1 / 160_000), (4, 1e-10)):
        s = torch.linspace(0, -math.log(cutoff), 200_001)
        z = s * 0.5**q
        e = torch.zeros_like(z)
        for c in reversed((1.0, *EXP)):
            e = c + z * e
        for _ in range(q):
            e = e * e
        exact = torch.exp(-s.double())
        found.append({"squarings": q, "absolute": float((e - exact).abs().max()), "relative": float((e / exact - 1).abs().max())})
    return found


def table(found: list[dict]) -> str:
    lines = ["| knob | setting | ms | largest error | 99.9th percentile | PSNR to truth |", "|---|---|---|---|---|---|"]
    for r in found:
        if math.isnan(r["max"]):
            lines.append(f"| {r['knob']} | {r['setting']} | not drawn yet | | | |")
        else:
            lines.append(f"| {r['knob']} | {r['setting']} | {r['ms']:.1f} | {r['max']:.1e} | {r['p99.9']:.1e} | {r['psnr']:.1f} |")
    return "\n".join(lines)


def charts(found: list[dict], title: str) -> list[Chart]:
    lines: dict[str, list] = {}
    tails: dict[str, list] = {}
    for r in found:
        lines.setdefault(r["knob"], []).append((r["ms"], r["max"]))
        tails.setdefault(r["knob"], []).append((r["ms"], r["p99.9"]))
    return [
        Chart(f"{title}: largest error of a pixel", "ms a frame", "error, colour units", lines),
        Chart(f"{title}: 99.9th percentile of error", "ms a frame", "error, colour units", tails),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.accuracy", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--scene", choices=("cloud", "drive"), default="cloud")
    parser.add_argument("--size", default="320x208")
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--clock", choices=CLOCKS, default="wall", help="cpu: of all threads together, for a busy machine")
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    width, height = (int(v) for v in args.size.split("x"))
    preset = cloud(width, height) if args.scene == "cloud" else drive(width, height)
    found = rows(preset, lambda work: timed(work, args.repeat, args.clock))
    print(
        f"{args.scene}, {len(preset)} splats, {args.size}, {torch.get_num_threads()} threads, median ms ({args.clock})\n\n{table(found)}\n"
    )
    pixels = ut_in_pixels()
    print(f"UT in float32 at 3840x2160, f = 2000 px: {', '.join(f'{k} {v:.1e}' for k, v in pixels.items())} px\n")
    print("| exp(-s): squarings | largest error | of itself |\n|---|---|---|")
    for e in exp_errors():
        print(f"| {e['squarings']} | {e['absolute']:.1e} | {e['relative']:.1e} |")
    if args.json:
        args.json.write_text(json.dumps({"rows": found, "ut_pixels": pixels, "exp": exp_errors()}, indent=1))
    if args.plot:
        save(charts(found, f"{args.scene} {args.size}"), args.plot)


if __name__ == "__main__":
    main()
