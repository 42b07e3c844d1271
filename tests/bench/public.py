"""What the rewrites of Harmonizer's graph save: milliseconds and weights against the unmodified graph, and how far the results are apart.

    python -m tests.bench.public [--size 320x192] [--narrow 1] [--repeat 1] [--clock cpu] [--device cuda] [--json public.json]

Random weights in Cosmos-Predict2 0.6B's and the Wan autoencoder's sizes; the unmodified graphs are diffusers' own, in float32. The last
rows are whole steps as `sidestep enhance --weights` takes them, in bfloat16 where that is fast. --narrow n makes all of it n times
narrower.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import torch
from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan
from diffusers.models.transformers.transformer_cosmos import CosmosTransformer3DModel

from enhance.public.cosmos import Denoiser
from enhance.public.diffusers_names import AUTOENCODER, TRANSFORMER, released
from enhance.public.enhancer import PublicEnhancer, Recent
from enhance.public.harmonizer import Cosmos
from enhance.public.wan import MEAN, STD, Autoencoder
from tests.bench.measure import CLOCKS, in_turns

HERE = Path("random weights")


def weights(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def works(width: int, height: int, narrow: int, device: str) -> dict[str, tuple[Callable[[], torch.Tensor], int, str]]:
    """What is timed, its weights, and what it is compared with ("" for an unmodified graph)."""
    torch.manual_seed(0)
    net = CosmosTransformer3DModel(
        in_channels=17, num_attention_heads=max(20 // narrow, 1), attention_head_dim=64, num_layers=20, text_embed_dim=1024,
        rope_scale=(1.0, 4.0, 4.0), concat_padding_mask=False, extra_pos_embed_type=None,
    ).eval()  # fmt: skip
    vae = AutoencoderKLWan(base_dim=96 // narrow, latents_mean=list(MEAN), latents_std=list(STD)).eval()
    ours = Denoiser.read(HERE, released(net.state_dict(), TRANSFORMER))
    halves = Autoencoder.read(HERE, released(vae.state_dict(), AUTOENCODER))
    single = Autoencoder.read(HERE, released(vae.state_dict(), AUTOENCODER), single=True)
    model = Cosmos("Harmonizer", deepcopy(ours), deepcopy(halves), 4)
    net, vae, ours, halves, single = (module.to(device) for module in (net, vae, ours, halves, single))
    clip = (torch.rand(1, 3, 5, height, width) * 2 - 1).to(device)
    z = torch.randn(1, 16, 2, height // 8, width // 8).to(device)
    time, text = torch.tensor([0.2], device=device), torch.zeros(1, 512, 1024, device=device)
    mean, std = (torch.tensor(v, device=device).view(1, 16, 1, 1, 1) for v in (MEAN, STD))

    def whole(t: int) -> torch.Tensor:
        x = torch.cat([0.8 * z[:, :, :t], torch.zeros_like(z[:, :1, :t])], 1)
        return 0.8 * z[:, :, :t] - 0.2 * net(x, time, text).sample

    _, features = single.encode(clip[:, :, :1])
    made: dict[str, tuple[Callable[[], torch.Tensor], int, str]] = {}

    def pair(name: str, before: Callable, module: torch.nn.Module, how: str, after: Callable, folded: torch.nn.Module) -> None:
        made[f"{name}: unmodified"] = (before, weights(module), "")
        made[f"{name}: {how}"] = (after, weights(folded), f"{name}: unmodified")

    for frames, t, mine in ((1, 1, single), (5, 2, halves)):
        x, y, said = clip[:, :, :frames], z[:, :, :t], f"{frames} frame{'s' * (frames > 1)}"
        pair(
            f"encode {said}", lambda x=x: (vae.encode(x).latent_dist.mode() - mean) / std, vae.encoder,
            "ours", lambda x=x, m=mine: m.encode(x)[0], mine.encoder,
        )  # fmt: skip
        pair(f"transformer, {said}", lambda t=t: whole(t), net, "folded", lambda y=y: ours(y), ours)
        pair(
            f"decode {said}", lambda y=y: vae.decode(y * std + mean).sample[:, :, 0], vae.decoder,
            "the current one", lambda y=y: halves.decode(y, features).clamp(-1, 1), halves.decoder,
        )  # fmt: skip
    rgb, alone = torch.rand(height, width, 3), PublicEnhancer(model, device=device, history=0)
    after, past = PublicEnhancer(model, device=device), Recent(rgb.to(device), (rgb.to(device),) * model.history)
    made["a step alone"] = (lambda: alone.step(rgb)[0], weights(model), "")
    made["a step with four results"] = (lambda: after.step(rgb, past)[0], weights(model), "")
    return made


def rows(width: int, height: int, narrow: int, repeat: int, clock: str, device: str) -> list[dict]:
    with torch.inference_mode():
        made = works(width, height, narrow, device)
        ms = in_turns({name: work for name, (work, _, _) in made.items()}, repeat, clock, rounds=1)
        found = []
        for name, (work, count, other) in made.items():
            apart = float((work() - made[other][0]()).abs().max()) if other else None
            saved = 1 - ms[name] / ms[other] if other else None
            found.append({"work": name, "ms": ms[name], "weights": count, "saved": saved, "apart": apart})
    return found


def table(found: list[dict]) -> str:
    lines = ["| work | ms | million weights | time saved | largest difference |", "|---|---|---|---|---|"]
    for r in found:
        last = ("-", "-") if r["saved"] is None else (f"{100 * r['saved']:.0f} %", f"{r['apart']:.0e}")
        lines.append(f"| {r['work']} | {r['ms']:.0f} | {r['weights'] / 1e6:.0f} | {' | '.join(last)} |")
    return "\n".join(lines)


def main() -> None:
    how = argparse.RawTextHelpFormatter
    parser = argparse.ArgumentParser(prog="python -m tests.bench.public", description=__doc__, formatter_class=how)
    parser.add_argument("--size", default="320x192", help="multiples of 16")
    parser.add_argument("--narrow", type=int, default=1)
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--clock", choices=CLOCKS, default="wall", help="cpu: of all threads together, for a busy machine")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    width, height = (int(v) for v in args.size.split("x"))
    found = rows(width, height, args.narrow, args.repeat, args.clock, args.device)
    print(f"{args.size}, {args.device}, {torch.get_num_threads()} threads, median ms ({args.clock})\n\n{table(found)}")
    if args.json:
        args.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
