"""Milliseconds and error of whole frames on a GPU, beside gsplat and gswarp, forward and forward + backward, in one run.

    python -m tests.bench.peers [--only NAME,NAME] [--drive FOLDER] [--lund FOLDER] [--repeat 30] [--json FILE]

Each library runs in a process of its own, so that a crash is its own; what cannot be imported says why in its row. gsplat and gswarp are
given opacities, scales and quaternions as they take them, so that what turns ours into those (exp, sigmoid, normalising) counts for us
alone. "ours, recorded" replays a CUDA graph.

Error is against our own kernels with a budget of 1/4096 and every pixel's own order, of the same projection and response: mean absolute
and 99.9th percentile of colour. Nothing here asserts a time.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from render import RenderConfig, rasterize
from render.captured import Captured
from render.room import Room, one_ahead
from scenes import Camera, Gaussians, Pinhole, SplatModel
from scenes.harmonics import turned
from scenes.poses import inverse, quat_from_matrix, quat_product
from tests.bench.presets import Missing, Preset, presets

EWA, UT, RAYS = SplatModel(projection="ewa"), SplatModel(projection="ut"), SplatModel(projection="ut", response="ray")
TRUTH = RenderConfig(max_error=1 / 4096)
NEAR = 0.1
"""Metres; ours, which the others are told."""


@dataclass(frozen=True)
class Way:
    """A rasterizer with its settings. `forward` gives rgb `[H, W, 3]`; `leaves` are what its backward differentiates by."""

    forward: Callable[[], torch.Tensor]
    train: Callable[[], torch.Tensor] | None
    leaves: list[torch.Tensor]
    model: SplatModel


def whole(preset: Preset) -> Gaussians:
    """All splats of a preset in the world, on the GPU, as the peers take them: of one degree of harmonics."""
    most = max(p.gaussians.sh.shape[1] for p in preset.placed)
    parts = []
    for p in preset.placed:
        g, pose = p.gaussians, p.world_from_local
        turn = quat_from_matrix(pose[:3, :3]).float()
        means = (g.means.double() @ pose[:3, :3].mT + pose[:3, 3]).float()
        sh = torch.nn.functional.pad(turned(g.sh, pose[:3, :3]), (0, 0, 0, most - g.sh.shape[1]))
        parts.append(replace(g, means=means, quats=quat_product(turn.expand(len(g), 4), g.quats), sh=sh))
    return Gaussians.cat(parts).to("cuda")


def ours(g: Gaussians, camera: Camera, model: SplatModel, config: RenderConfig = RenderConfig()) -> Way:  # noqa: B008 - frozen
    leaves = g.map(lambda t: t.clone().requires_grad_())
    return Way(
        lambda: rasterize(g, camera, ("rgb",), model=model, config=config).rgb,
        lambda: rasterize(leaves, camera, ("rgb",), model=model, config=config).rgb,
        list(leaves.tensors().values()),
        model,
    )


def in_a_room(g: Gaussians, camera: Camera, model: SplatModel) -> Way:
    """As clips are drawn: no frame waits for a count."""
    room = Room()

    def forward() -> torch.Tensor:
        frames = one_ahead(lambda c: rasterize(g, c, ("rgb",), model=model, room=room), [camera], room)
        return [f.rgb for f in frames][-1]

    return Way(forward, None, [], model)


def recorded(g: Gaussians, camera: Camera, model: SplatModel) -> Way:
    captured = Captured(g, camera, ("rgb",), model=model)
    return Way(lambda: [f.rgb for f in captured.frames([camera])][-1], None, [], model)


def gsplat(g: Gaussians, camera: Camera, model: SplatModel, packed: bool) -> Way:
    from gsplat import rasterization

    more = {"with_ut": model.projection == "ut", "with_eval3d": model.response == "ray"}
    view = inverse(camera.world_from_cam).float().cuda()[None]
    lens = torch.tensor(
        [[[camera.lens.fx, 0, camera.lens.cx], [0, camera.lens.fy, camera.lens.cy], [0, 0, 1]]], dtype=torch.float32, device="cuda"
    )
    degree = math.isqrt(g.sh.shape[1]) - 1

    def draw(fields) -> torch.Tensor:
        means, quats, scales, opacities, sh = fields
        return rasterization(
            means, quats, scales, opacities, sh, view, lens, camera.width, camera.height, near_plane=NEAR, sh_degree=degree,
            packed=packed, eps2d=model.dilation, **more,
        )[0][0]  # fmt: skip

    fields = [t.contiguous() for t in (g.means, g.quats, g.log_scales.exp(), g.logit_opacities.sigmoid(), g.sh)]
    leaves = [t.clone().requires_grad_() for t in fields]
    return Way(lambda: draw(fields), lambda: draw(leaves), leaves, model)


def gswarp(g: Gaussians, camera: Camera, model: SplatModel) -> Way:
    from gswarp import GaussianRasterizationSettings, GaussianRasterizer

    view = inverse(camera.world_from_cam).float().cuda()
    tan_x, tan_y = camera.width / (2 * camera.lens.fx), camera.height / (2 * camera.lens.fy)
    far, near = 1000.0, 0.01
    clip = torch.zeros(4, 4, device="cuda")
    clip[0, 0], clip[1, 1], clip[2, 2], clip[2, 3], clip[3, 2] = 1 / tan_x, 1 / tan_y, far / (far - near), -far * near / (far - near), 1
    settings = GaussianRasterizationSettings(
        camera.height, camera.width, tan_x, tan_y, torch.zeros(3, device="cuda"), 1.0, view.T.contiguous(), (clip @ view).T.contiguous(),
        math.isqrt(g.sh.shape[1]) - 1, camera.world_from_cam[:3, 3].float().cuda(), False, auto_tune_verbose=False,
    )  # fmt: skip
    draw_with = GaussianRasterizer(settings)

    def draw(fields) -> torch.Tensor:
        means, quats, scales, opacities, sh = fields
        flat = torch.zeros_like(means, requires_grad=means.requires_grad)
        rgb, *_ = draw_with(means3D=means, means2D=flat, opacities=opacities, shs=sh, scales=scales, rotations=quats)
        return rgb.permute(1, 2, 0)

    quats = torch.nn.functional.normalize(g.quats, dim=1)
    fields = [t.contiguous() for t in (g.means, quats, g.log_scales.exp(), g.logit_opacities.sigmoid()[:, None], g.sh)]
    leaves = [t.clone().requires_grad_() for t in fields]
    return Way(lambda: draw(fields), lambda: draw(leaves), leaves, model)


WAYS: dict[str, Callable[[Gaussians, Camera], Way]] = {
    "ours, EWA": lambda g, c: ours(g, c, EWA),
    "ours, EWA, as a clip": lambda g, c: in_a_room(g, c, EWA),
    "ours, EWA, recorded": lambda g, c: recorded(g, c, EWA),
    "gsplat, EWA": lambda g, c: gsplat(g, c, EWA, False),
    "gsplat, EWA, packed": lambda g, c: gsplat(g, c, EWA, True),
    "gswarp, EWA": lambda g, c: gswarp(g, c, EWA),
    "ours, UT": lambda g, c: ours(g, c, UT),
    "ours, UT, recorded": lambda g, c: recorded(g, c, UT),
    "gsplat, UT": lambda g, c: gsplat(g, c, UT, False),
    "ours, UT along rays": lambda g, c: ours(g, c, RAYS),
    "gsplat, UT along rays": lambda g, c: gsplat(g, c, RAYS, False),
    "ours, UT along rays, 1/255": lambda g, c: ours(g, c, RAYS, RenderConfig(max_error=1 / 255)),
}


def milliseconds(work: Callable[[], object], repeat: int) -> float:
    """Median over single calls, each waited for: what a caller sees, launches by the host included."""
    work()
    times = []
    for _ in range(repeat):
        torch.cuda.synchronize()
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        work()
        end.record()
        end.synchronize()
        times.append(start.elapsed_time(end))
    return statistics.median(times)


def step(way: Way, weights: torch.Tensor) -> None:
    assert way.train is not None
    (way.train() * weights).sum().backward()
    for leaf in way.leaves:
        leaf.grad = None


def measure(name: str, preset: Preset, library: str, repeat: int) -> Iterator[dict]:
    """Rows of one library's ways."""
    g, camera = whole(preset), replace(preset.camera, world_from_cam_end=None, shutter="global")
    if not isinstance(camera.lens, Pinhole):
        camera = replace(camera, lens=Pinhole(camera.lens.fx, camera.lens.fy, camera.lens.cx, camera.lens.cy))
    weights = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(0)).cuda()
    truths: dict[SplatModel, torch.Tensor] = {}
    for way_name, make in WAYS.items():
        if way_name.split(",")[0] != library:
            continue
        row: dict = {"preset": name, "splats": len(g), "size": f"{camera.width}x{camera.height}", "way": way_name}
        try:
            way = make(g, camera)
            rgb = way.forward()
            if way.model not in truths:
                truths[way.model] = rasterize(g, camera, ("rgb",), model=way.model, config=TRUTH).rgb
            off = (rgb - truths[way.model]).abs().amax(-1).flatten()
            row["mean"] = float((rgb - truths[way.model]).abs().mean())
            row["p999"] = float(off.kthvalue(max(1, math.ceil(0.999 * len(off)))).values)
            torch.cuda.reset_peak_memory_stats()
            held = torch.cuda.memory_allocated()
            row["forward"] = milliseconds(way.forward, repeat)
            if way.train is not None:
                row["both"] = milliseconds(lambda way=way: step(way, weights), repeat)
            row["memory"] = torch.cuda.max_memory_allocated() - held
        except Exception as error:  # noqa: BLE001 - a peer's failure is a row of the table
            row["missing"] = f"{type(error).__name__}: {str(error).strip().splitlines()[0] if str(error).strip() else ''}"[:160]
        yield row


def table(rows: list[dict]) -> str:
    lines = [
        "| preset | rasterizer | forward, ms | forward + backward, ms | peak memory, MiB | mean error | 99.9th percentile |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        head = f"| {r['preset']} {r['size']}, {r['splats']} | {r['way']} |"
        if "missing" in r:
            lines.append(f"{head} {r['missing']} | | | | |")
            continue
        both = f"{r['both']:.2f}" if "both" in r else ""
        lines.append(f"{head} {r['forward']:.2f} | {both} | {r['memory'] / 2**20:.0f} | {r['mean']:.1e} | {r['p999']:.1e} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.peers", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", help="comma-separated names of presets")
    parser.add_argument("--drive", type=Path, help="a scene folder of drive 002; the bundled demo's otherwise")
    parser.add_argument("--lund", type=Path, help="a scene folder of lund")
    parser.add_argument("--repeat", type=int, default=30)
    parser.add_argument("--json", type=Path, help="write all rows here")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("this benchmark needs a CUDA GPU; python -m tests.bench.speed measures on the CPU")
    makers = presets(args.drive, args.lund)
    names = args.only.split(",") if args.only else list(makers)
    if args.worker:
        for name in names:
            try:
                for row in measure(name, makers[name](), args.worker, args.repeat):
                    print(json.dumps(row), flush=True)
            except Missing as missing:
                print(f"{name}: {missing}", file=sys.stderr)
        return
    rows: list[dict] = []
    for library in dict.fromkeys(way.split(",")[0] for way in WAYS):
        command = [sys.executable, "-m", "tests.bench.peers", *sys.argv[1:], "--worker", library]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as worker:
            assert worker.stdout is not None
            for line in worker.stdout:
                rows.append(json.loads(line))
                print(table(rows[-1:]).splitlines()[-1], file=sys.stderr, flush=True)
        if worker.returncode:
            print(f"{library} broke off with exit code {worker.returncode}; what stood on stderr says why")
    rows.sort(key=lambda row: (names.index(row["preset"]), list(WAYS).index(row["way"])))
    card, driver = torch.cuda.get_device_name(), torch.version.cuda
    print(f"{card}, CUDA {driver}, torch {torch.__version__}, median of {args.repeat} single frames\n\n{table(rows)}")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
