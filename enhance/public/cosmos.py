"""The diffusion transformer of Cosmos-Predict2 (nvidia-cosmos/cosmos-predict2, `MiniTrainDIT`) run once, at one noise level, without text.

What the noise level alone decides is computed once and folded into weights, and what nothing can change is left out:
- time embedding and adaptive norms become the weight and bias of layer norms, gates go into the projections after them;
- text of zeros through projections without bias gives keys and values of zeros: cross-attention adds exactly 0 and is left out;
- the padding mask (and Video2World's condition mask) is 0: its columns of the patch embedding are left out;
- c_in and c_out of the preconditioning go into the first and the last projection.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn
from torch.nn import functional as F

from enhance.public.layout import State, finite, shape_of, strict

NAME = "Cosmos-Predict2"
LATENT = 16
PATCH = 2
BESIDE = r"accum_\w+|pos_embedder\.(seq|dim_spatial_range|dim_temporal_range)|(.*\.)?_extra_state"
"""What the releases write beside the weights: counters of the training, tables that follow from the sizes, Transformer Engine's state."""

STRETCH = {1: 4.0, 2: 3.0}
"""By the number of mask channels, 1 of Text2Image and 2 of Video2World (2B): how far positions in the picture are stretched."""

EPS = 1e-6


@dataclass(frozen=True)
class Sizes:
    """Of a transformer: its width, that of a head, of the adaptive norms, of the text and of the feed-forward layers; masks, blocks."""

    width: int
    head: int
    adaptive: int
    text: int
    inner: int
    masks: int
    blocks: int

    @classmethod
    def of(cls, path: Path, state: Mapping[str, object]) -> Sizes:
        """As the tensors' shapes tell. ValueError where one of those is missing or they contradict each other."""

        def sides(name: str, count: int = 2) -> tuple[int, ...]:
            return shape_of(path, NAME, state, name, count)

        width, columns = sides("x_embedder.proj.1.weight")
        head = sides("blocks.0.self_attn.q_norm.weight", 1)[0]
        blocks = 1 + max(int(name.split(".")[1]) for name in state if name.startswith("blocks.") and name.split(".")[1].isdigit())
        masks = columns // PATCH**2 - LATENT
        if columns % PATCH**2 or masks not in STRETCH or head < 1 or width % head or head % 2:
            raise ValueError(f"{path}: {width} channels in heads of {head}, {columns} values a patch are no size of {NAME}; fetch it again")
        return cls(
            width,
            head,
            sides("blocks.0.adaln_modulation_mlp.1.weight")[0],
            sides("blocks.0.cross_attn.k_proj.weight")[1],
            sides("blocks.0.mlp.layer1.weight")[0],
            masks,
            blocks,
        )

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Every weight of the release, by its name."""
        d, a = self.width, self.adaptive
        found: dict[str, tuple[int, ...]] = {
            "x_embedder.proj.1.weight": (d, PATCH**2 * (LATENT + self.masks)),
            "t_embedder.1.linear_1.weight": (d, d),
            "t_embedder.1.linear_2.weight": (3 * d, d),
            "t_embedding_norm.weight": (d,),
            "final_layer.linear.weight": (PATCH**2 * LATENT, d),
            "final_layer.adaln_modulation.1.weight": (a, d),
            "final_layer.adaln_modulation.2.weight": (2 * d, a),
        }
        for i in range(self.blocks):
            block: dict[str, tuple[int, ...]] = {"mlp.layer1.weight": (self.inner, d), "mlp.layer2.weight": (d, self.inner)}
            for kind, source in (("self_attn", d), ("cross_attn", self.text)):
                block |= {f"{kind}.{n}_proj.weight": (d, s) for n, s in (("q", d), ("k", source), ("v", source), ("output", d))}
                block |= {f"{kind}.{n}_norm.weight": (self.head,) for n in "qk"}
            for kind in ("self_attn", "cross_attn", "mlp"):
                block |= {f"adaln_modulation_{kind}.1.weight": (a, d), f"adaln_modulation_{kind}.2.weight": (3 * d, a)}
            found |= {f"blocks.{i}.{name}": shape for name, shape in block.items()}
        return found


def _kept(value: torch.Tensor) -> nn.Parameter:
    """Copied, for the file is mapped and may change."""
    return nn.Parameter(value.clone(), requires_grad=False)


def _folded(w: State, name: str, shared: torch.Tensor, time: torch.Tensor) -> list[nn.Parameter]:
    """What an adaptive norm comes to at one time: the weight and bias of a layer norm, and the gate where it has one."""
    shift, scale, *gate = (w[f"{name}.2.weight"] @ (w[f"{name}.1.weight"] @ F.silu(time)) + shared).split(len(time))
    return [_kept(1 + scale), _kept(shift), *map(_kept, gate)]


class Block(nn.Module):
    """Self-attention and feed-forward, each after a layer norm, their gates in their last projections."""

    def __init__(self, s: Sizes, w: State, shared: torch.Tensor, time: torch.Tensor):
        """w: the block's tensors; shared `[3 D]` and time `[D]`: what every adaptive norm adds, and is made from."""
        super().__init__()
        self.head = s.head
        self.attn_scale, self.attn_shift, gate = _folded(w, "adaln_modulation_self_attn", shared, time)
        self.qkv = _kept(torch.cat([w[f"self_attn.{n}_proj.weight"] for n in "qkv"]))
        self.q_norm, self.k_norm = _kept(w["self_attn.q_norm.weight"]), _kept(w["self_attn.k_norm.weight"])
        self.attn_out = _kept(gate[:, None] * w["self_attn.output_proj.weight"])
        self.mlp_scale, self.mlp_shift, gate = _folded(w, "adaln_modulation_mlp", shared, time)
        self.mlp_in = _kept(w["mlp.layer1.weight"])
        self.mlp_out = _kept(gate[:, None] * w["mlp.layer2.weight"])

    def forward(self, x: torch.Tensor, cos: torch.Tensor, sin: torch.Tensor) -> torch.Tensor:
        """x `[B, N, D]`; cos, sin `[N, head]`."""
        normed = F.layer_norm(x, x.shape[-1:], self.attn_scale, self.attn_shift, EPS)
        q, k, v = F.linear(normed, self.qkv).unflatten(-1, (3, -1, self.head)).permute(2, 0, 3, 1, 4)
        q = turned(F.rms_norm(q, (self.head,), self.q_norm, EPS), cos, sin)
        k = turned(F.rms_norm(k, (self.head,), self.k_norm, EPS), cos, sin)
        x = x + F.linear(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2), self.attn_out)
        normed = F.layer_norm(x, x.shape[-1:], self.mlp_scale, self.mlp_shift, EPS)
        return x + F.linear(F.gelu(F.linear(normed, self.mlp_in)), self.mlp_out)


class Denoiser(nn.Module):
    """What is left of the transformer at one noise level: latents in, clean latents out."""

    def __init__(self, s: Sizes, w: State, sigma: float):
        """w: the release's tensors, float32. sigma: noise against signal; 0.25 of Harmonizer and Fixer (their timestep 250 of 1000)."""
        super().__init__()
        self.sizes, self.t = s, sigma / (1 + sigma)
        half = s.width // 2
        angles = self.t * torch.exp(-math.log(10000) * torch.arange(half) / half)
        sample = torch.cat([angles.cos(), angles.sin()])
        shared = w["t_embedder.1.linear_2.weight"] @ F.silu(w["t_embedder.1.linear_1.weight"] @ sample)
        time = F.rms_norm(sample, (s.width,), w["t_embedding_norm.weight"], EPS)
        self.blocks = nn.ModuleList(
            Block(s, {k.split(".", 2)[2]: v for k, v in w.items() if k.startswith(f"blocks.{i}.")}, shared, time) for i in range(s.blocks)
        )
        self.scale, self.shift = _folded(w, "final_layer.adaln_modulation", shared[: 2 * s.width], time)
        self.first = _kept((1 - self.t) * w["x_embedder.proj.1.weight"][:, : PATCH**2 * LATENT])
        self.last = _kept(-self.t * w["final_layer.linear.weight"])

    @classmethod
    def read(cls, path: Path, state: Mapping[str, object], sigma: float = 0.25) -> Denoiser:
        """From the released tensors, named without `net.`; in float32. ValueError as `strict`."""
        sizes = Sizes.of(path, state)
        found = strict(path, NAME, state, sizes.shapes(), BESIDE)
        net = cls(sizes, {name: value.float() for name, value in found.items()}, sigma)
        finite(path, net)
        return net.eval().requires_grad_(False)

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        """Latents `[B, 16, T, h, w]`, sides even, to (1 - t) z - t net((1 - t) z, t) with t = sigma / (1 + sigma)."""
        b, c, t, height, width = z.shape
        patches = z.view(b, c, t, height // PATCH, PATCH, width // PATCH, PATCH).permute(0, 2, 3, 5, 1, 4, 6).flatten(4)
        size = patches.shape[1:4]
        x = F.linear(patches.flatten(1, 3).to(self.first.dtype), self.first)
        cos, sin = (table.to(x) for table in positions(size, self.sizes.head, STRETCH[self.sizes.masks], z.device))
        for block in self.blocks:
            x = block(x, cos, sin)
        x = F.linear(F.layer_norm(x, x.shape[-1:], self.scale, self.shift, EPS), self.last).to(z.dtype)
        change = x.view(b, *size, PATCH, PATCH, c).permute(0, 6, 1, 2, 4, 3, 5).reshape(z.shape)
        return (1 - self.t) * z + change


def positions(size: tuple[int, ...], head: int, stretch: float, device: torch.device | str) -> tuple[torch.Tensor, torch.Tensor]:
    """Cosines and sines `[t h w, head]` of rotary positions: a third of the channels turn with the row, a third with the column, the rest
    with time; `stretch` slows the first two (NTK: base 10000 stretch^(d / (d - 2)))."""
    across = head // 6 * 2
    axes = []
    for i, (n, d) in enumerate(zip(size, (head - 2 * across, across, across), strict=True)):
        base = 10000.0 * (stretch if i else 1.0) ** (d / (d - 2))
        speeds = base ** -(torch.arange(0, d, 2, device=device) / d)
        angles = torch.arange(n, device=device, dtype=torch.float32)[:, None] * speeds
        axes.append(angles.view([n if j == i else 1 for j in range(3)] + [-1]).expand(*size, -1))
    angles = torch.cat([*axes, *axes], -1).flatten(0, 2)
    return angles.cos(), angles.sin()


def turned(x: torch.Tensor, cos: torch.Tensor, sin: torch.Tensor) -> torch.Tensor:
    """x `[..., N, head]` with each channel of the first half turned together with its fellow of the second."""
    first, second = x.chunk(2, -1)
    return x * cos + torch.cat([-second, first], -1) * sin
