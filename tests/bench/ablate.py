"""What each part of the enhancer's training is worth: the whole, and the whole less one part, trained alike on little.

    python -m tests.bench.ablate PAIRS... [-o ablation] [--steps 150] [--limit 4] [--only ROW ...]

Pairs are halved (320x180 of 640x360), every second training clip is used. The autoencoder is the shipped one; prior, objects' colours,
missing shadows and the enhancer are trained anew in each row, with the same seed and steps. Measured are held-out clips, told their
objects, as `render --enhance` tells them. Identity first, then the whole; a kind left out is no damage that is trained on. NAFNet sees the
same samples one by one. One thread; a run that was broken off goes on where it stopped, and a row that is there is not trained again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional as F

from enhance.enhancer import Enhancer
from enhance.evaluate import TOLD, Row, measured, shipped_features
from enhance.network.net import Net, told_of
from enhance.network.precision import autocast, channels_last
from enhance.network.weights_file import BUILTIN, load_net, save_net
from enhance.pairs.shards import KINDS, RENDERED, PairSet, Shard, to_bytes, write_shard
from enhance.step import Steps
from enhance.training.losses import PatchPerceptual, pixel_loss
from enhance.training.run import TrainConfig
from enhance.training.samples import Sampler
from enhance.training.train import train
from render.frame_types import Frame
from scenes.atomic import atomic_file
from scenes.spread import spread
from tests.bench.nafnet import NafNet

CONFIG = TrainConfig(crop=96, images=6, clips=2, looked_at=16, objects=0.2, shade=0.1, rate=1.6e-3)
LEARNT_BY_OBJECTS = ("isp", "relight", "shadow", "reinsert")
"""Kinds that what is known of objects comes from."""


@dataclass(frozen=True)
class Variant:
    """A row: how it is trained, whether it has the prior, and whether it looks at other frames than the one."""

    config: TrainConfig = CONFIG
    prior: bool = True
    clips: bool = True


def variants(kinds: list[str]) -> dict[str, Variant]:
    """By name, the whole first."""
    known = replace(CONFIG, kinds=tuple(kinds))
    rows = {
        "the whole": Variant(known),
        "no prior": Variant(known, prior=False),
        "no perceptual loss": Variant(replace(known, perceptual=0.0)),
        "no temporal loss": Variant(replace(known, temporal=0.0)),
        "no temporal layers": Variant(replace(known, frames=1), clips=False),
    }
    return rows | {f"without {kind}": Variant(replace(known, kinds=tuple(k for k in kinds if k != kind))) for kind in kinds}


@dataclass(frozen=True)
class Alone:
    """An enhancer that sees every frame as if it were the first."""

    enhancer: Steps

    def step(self, frame: Frame, memory: None = None) -> tuple[torch.Tensor, None]:
        return self.enhancer.step(replace(frame, flow_prev=None))[0], None


@dataclass(frozen=True)
class Baseline:
    """NAFNet behind an enhancer's call."""

    net: NafNet

    @torch.inference_mode()
    def step(self, frame: Frame, memory: None = None) -> tuple[torch.Tensor, None]:
        assert frame.rgb is not None and frame.instance is not None
        height, width = frame.rgb.shape[:2]
        pad = (0, -width % 16, 0, -height % 16)
        rgb = F.pad(frame.rgb.permute(2, 0, 1)[None], pad, mode="replicate")
        told = told_of(rgb, F.pad(frame.instance.float()[None, None], pad))
        with autocast(rgb.device):
            better = self.net(rgb, told)
        return better[0, :, :height, :width].permute(1, 2, 0).clamp(0, 1), None


def halved(pairs: PairSet, out: Path) -> PairSet:
    """Every clip held out and every second training clip at half the size, kept in `out`."""
    for split, every in (("train", 2), ("held out", 1)):
        for kind in KINDS:
            for shard in pairs.of(kind, split)[::every]:
                path = out / kind / shard.path.name
                if not path.with_suffix(".json").exists():
                    _halve(shard, path)
    return PairSet(out)


def _halve(shard: Shard, path: Path) -> None:
    w = shard.window()
    mean = {name: F.avg_pool2d(getattr(w, name), 2).permute(0, 2, 3, 1) for name in ("input", "target", "region", "flow")}
    instance = torch.where(w.instance < 0, 255, w.instance)[:, 0, ::2, ::2].to(torch.uint8)
    seen = F.avg_pool2d(w.visible, 2)[:, 0]
    tensors = {
        "input": to_bytes(mean["input"]),
        "target": to_bytes(mean["target"]),
        "region": to_bytes(mean["region"][..., 0]),
        "instance": instance,
        "flow": (mean["flow"] / 2).to(torch.float16),
        "visible": (seen == 1).to(torch.uint8),
        "depth": torch.full(instance.shape, torch.inf, dtype=torch.float16),
    }
    write_shard(path, tensors, {k: v for k, v in shard.meta.items() if k not in ("frames", "height", "width")})


class Bench:
    """The trainings, each in a folder of its own of `out`."""

    def __init__(self, pairs: PairSet, out: Path, steps: int, seed: int):
        self.pairs, self.out, self.steps, self.seed = pairs, out, steps, seed

    def started(self) -> Path:
        """Untrained weights but for the shipped autoencoder."""
        path = self.out / "start.safetensors"
        if not path.exists():
            torch.manual_seed(self.seed)
            net, shipped = Net(), load_net(BUILTIN)[0]
            net.encoder.load_state_dict(shipped.encoder.state_dict())
            save_net(net, path, {})
        return path

    def trained(self, name: str, start: Path, config: TrainConfig, *stages: str, share: float = 1.0) -> Path:
        folder = self.out / name.replace(" ", "_")
        weights = folder / "enhancer.safetensors"
        if not weights.exists():
            say = lambda done, line: print(f"{name}: {100 * done:.0f} % {line}", flush=True)  # noqa: E731
            steps = max(1, round(share * self.steps))
            begun = (folder / "checkpoint.pt").exists()
            train(self.pairs, folder, steps=steps, seed=self.seed, resume=begun, config=config, start=start, only=stages, progress=say)
        return weights

    def enhancer(self, name: str, variant: Variant, kinds: list[str]) -> Steps | Alone:
        start = self.started()
        used = tuple(k for k in kinds if k in variant.config.kinds or k not in LEARNT_BY_OBJECTS)
        part = " without ".join(["objects", *(k for k in kinds if k not in used)])
        stages = ("objects", "shade") if "shadow" in used else ("objects",)  # without its pairs there is nothing to train shade on
        looked = self.trained(part, start, replace(CONFIG, kinds=used), *stages, share=3.0)
        begun = self.out / name.replace(" ", "_") / "start.safetensors"
        if not begun.exists():
            net = load_net(self.trained("prior", start, CONFIG, "prior", share=0.5) if variant.prior else start)[0]
            net.objects.load_state_dict(load_net(looked)[0].objects.state_dict())
            begun.parent.mkdir(exist_ok=True)
            save_net(net, begun, {})
        # in so few steps none is found worth running
        found = Enhancer.load(self.trained(name, begun, variant.config, "enhancer"), repair=True)
        return found if variant.clips else Alone(found)

    def baseline(self, kinds: list[str]) -> Baseline:
        """NAFNet on the samples of the whole, with the losses that a single frame has."""
        path = self.out / "nafnet.pt"
        torch.manual_seed(self.seed)
        net = channels_last(NafNet())
        if path.exists():
            net.load_state_dict(torch.load(path, weights_only=True))
            return Baseline(net.eval())
        sampler = Sampler(self.pairs, None, self.seed, kinds)
        perceptual = PatchPerceptual(load_net(BUILTIN)[0].encoder)
        optimiser = torch.optim.AdamW(net.parameters(), betas=(0.9, 0.9), weight_decay=0.0)
        for step in range(self.steps):
            rate = 1e-3 * min(1.0, (step + 1) / 20) * (0.505 + 0.495 * np.cos(np.pi * step / self.steps))
            optimiser.param_groups[0]["lr"] = float(rate)
            sample = sampler.batch(2 * step + 1, CONFIG.images, 1, CONFIG.crop)
            given, target = sample.input[:, 0], sample.target[:, 0]
            with autocast(given.device):
                out = net(given, torch.nan_to_num(told_of(given, sample.mask[:, 0])))
                seen = perceptual(out, target, np.random.default_rng([self.seed, 7, step]))
            loss = pixel_loss(out, target, CONFIG.logarithm) + CONFIG.perceptual * seen
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimiser.step()
            if step % 20 == 0:
                print(f"NAFNet: step {step}, loss {float(loss.detach()):.4f}", flush=True)
        with atomic_file(path) as half:
            torch.save(net.state_dict(), half)
        return Baseline(net.eval())


def table(rows: dict[str, dict[str, list[float]]], kinds: list[str]) -> str:
    """Markdown: of each kind the PSNR in the region (of the whole frame for clean ones) and the warp error in levels."""
    lines = [f"| | {' | '.join(kinds)} |", "|" + (len(kinds) + 1) * "---|"]
    for name, by_kind in rows.items():
        cells = (" / ".join("equal" if np.isinf(v) else f"{v:.2f}" for v in by_kind[kind]) for kind in kinds)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def suited(enhancer: Steps | Alone | None, kind: str) -> Steps | Alone | None:
    """The enhancer as it treats frames of a kind: photos, into which something was put, are not repaired."""
    if isinstance(enhancer, Enhancer) and kind not in RENDERED:
        return enhancer.for_photos()
    return replace(enhancer, enhancer=suited(enhancer.enhancer, kind)) if isinstance(enhancer, Alone) else enhancer


def _measured(name: str, enhancer, pairs: PairSet, kinds: list[str], limit: int) -> dict[str, list[float]]:
    features, found = shipped_features(), {}
    for kind in kinds:
        method, clips = "identity" if name == "identity" else TOLD, spread(pairs.of(kind, "held out"), limit)
        row: Row = measured(kind, method, clips, suited(enhancer, kind), features)
        found[kind] = [row.mean("frame" if kind == "clean" else "region"), row.mean("warp error")]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.ablate", description=__doc__)
    parser.add_argument("pairs", type=Path, nargs="+", help="folders that sidestep pairs made")
    parser.add_argument("-o", "--output", type=Path, default=Path("ablation"), help="folder of the trainings")
    parser.add_argument("--steps", type=int, default=150, help="steps of the enhancer in each row")
    parser.add_argument("--limit", type=int, default=4, help="most held-out clips of a kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", help="names of rows")
    options = parser.parse_args()
    torch.set_num_threads(1)
    pairs = halved(PairSet(*options.pairs), options.output / "pairs")
    kinds = [k for k in KINDS if pairs.of(k, "train") and pairs.of(k, "held out")]
    bench = Bench(pairs, options.output, options.steps, options.seed)
    makers: dict[str, Callable] = {"identity": lambda: None}
    for name, variant in variants(kinds).items():
        makers[name] = lambda name=name, variant=variant: bench.enhancer(name, variant, kinds)
        if name == "the whole":
            makers["NAFNet"] = lambda: bench.baseline(kinds)
    rows = {}
    for name, make in makers.items():
        if options.only and name not in options.only:
            continue
        note = options.output / "rows" / f"{name.replace(' ', '_')}_{options.limit}.json"
        if not note.exists():
            note.parent.mkdir(exist_ok=True)
            found = _measured(name, make(), pairs, kinds, options.limit)
            with atomic_file(note) as half:
                Path(half).write_text(json.dumps(found))
        rows[name] = json.loads(note.read_text())
        print(f"\n{table(rows, kinds)}\n", flush=True)


if __name__ == "__main__":
    main()
