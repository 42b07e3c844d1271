"""CLIP's text encoder, for the one prompt that Difix was trained with: run once when it is loaded, then let go.

Tensors are named as huggingface/transformers' `CLIPTextModel` writes them; words are split as vocab.json and merges.txt of its tokenizer
say.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import torch
from torch.nn import functional as F

from enhance.public.layout import State, shape_of, strict

NAME = "the text encoder of Difix"
ACTIVATIONS = {"gelu": F.gelu, "quick_gelu": lambda x: x * torch.sigmoid(1.702 * x)}


def tokens(folder: Path, prompt: str, length: int) -> torch.Tensor:
    """`[1, length]` ids of a prompt of plain words, begun, ended and filled up as a tokenizer's folder says. ValueError where it cannot."""
    try:
        vocabulary = json.loads((folder / "vocab.json").read_text())
        merges = [tuple(line.split()) for line in (folder / "merges.txt").read_text().splitlines()[1:] if line.strip()]
        named = json.loads((folder / "special_tokens_map.json").read_text())
        first, last, fill = (_token(named[f"{name}_token"]) for name in ("bos", "eos", "pad"))
        order = {pair: rank for rank, pair in enumerate(merges)}
        words = [piece for word in prompt.lower().split() for piece in _pieces(word, order)]
        ids = [vocabulary[piece] for piece in (first, *words, last)]
        return torch.tensor([ids + [vocabulary[fill]] * (length - len(ids))])
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"{folder} is not a complete tokenizer of Difix ({error}); fetch the folder again") from error


def _token(named: str | Mapping[str, str]) -> str:
    return named if isinstance(named, str) else named["content"]


def _pieces(word: str, order: Mapping[tuple[str, ...], int]) -> list[str]:
    """Byte pair encoding: neighbours that merge first are merged first."""
    pieces = [*word[:-1], word[-1] + "</w>"]
    while len(pieces) > 1:
        pairs = list(zip(pieces, pieces[1:], strict=False))
        best = min(pairs, key=lambda pair: order.get(pair, len(order)))
        if best not in order:
            break
        i = pairs.index(best)
        pieces[i : i + 2] = [pieces[i] + pieces[i + 1]]
    return pieces


def shapes(path: Path, state: Mapping[str, object], inner: int) -> dict[str, tuple[int, ...]]:
    """Every tensor of an encoder of the sizes that `state` shows; `inner`: the feed-forward layers' width."""
    words, width = shape_of(path, NAME, state, "text_model.embeddings.token_embedding.weight", 2)
    length = shape_of(path, NAME, state, "text_model.embeddings.position_embedding.weight", 2)[0]
    found: dict[str, tuple[int, ...]] = {
        "embeddings.token_embedding.weight": (words, width),
        "embeddings.position_embedding.weight": (length, width),
        "final_layer_norm.weight": (width,),
        "final_layer_norm.bias": (width,),
    }
    layers = {int(name.split(".")[3]) for name in state if name.startswith("text_model.encoder.layers.")}
    for i in range(len(layers)):
        linear: dict[str, tuple[int, ...]] = {f"self_attn.{n}_proj": (width, width) for n in ("q", "k", "v", "out")}
        linear |= {"mlp.fc1": (inner, width), "mlp.fc2": (width, inner), "layer_norm1": (width,), "layer_norm2": (width,)}
        for name, shape in linear.items():
            found[f"encoder.layers.{i}.{name}.weight"], found[f"encoder.layers.{i}.{name}.bias"] = shape, shape[:1]
    return {f"text_model.{name}": shape for name, shape in found.items()}


@torch.no_grad()
def encoded(path: Path, state: Mapping[str, object], config: Mapping, ids: torch.Tensor) -> torch.Tensor:
    """`[1, N, D]`: the last layer's states, normed, of `ids` `[1, N]`. ValueError as `strict`."""
    kept = strict(path, NAME, state, shapes(path, state, int(config["intermediate_size"])), r"text_model\.embeddings\.position_ids")
    w: State = {name.removeprefix("text_model."): value.float() for name, value in kept.items()}
    heads, eps, act = int(config["num_attention_heads"]), float(config.get("layer_norm_eps", 1e-5)), ACTIVATIONS.get(config["hidden_act"])
    width = w["final_layer_norm.weight"].numel()
    if act is None or heads < 1 or width % heads:
        told = f"{width} channels in {heads} heads, and the activation {config['hidden_act']!r}"
        raise ValueError(f"{path.parent / 'config.json'}: {told}, are no text encoder of Difix's; fetch the folder again")
    x = w["embeddings.token_embedding.weight"][ids] + w["embeddings.position_embedding.weight"][: ids.shape[1]]

    def linear(x: torch.Tensor, name: str) -> torch.Tensor:
        return F.linear(x, w[f"{name}.weight"], w[f"{name}.bias"])

    def normed(x: torch.Tensor, name: str) -> torch.Tensor:
        return F.layer_norm(x, x.shape[-1:], w[f"{name}.weight"], w[f"{name}.bias"], eps)

    for i in range(sum(name.endswith("layer_norm1.weight") for name in w)):
        layer = f"encoder.layers.{i}"
        n = normed(x, f"{layer}.layer_norm1")
        q, k, v = (linear(n, f"{layer}.self_attn.{a}_proj").unflatten(-1, (heads, -1)).transpose(1, 2) for a in "qkv")
        seen = F.scaled_dot_product_attention(q, k, v, is_causal=True).transpose(1, 2).flatten(2)
        x = x + linear(seen, f"{layer}.self_attn.out_proj")
        n = normed(x, f"{layer}.layer_norm2")
        x = x + linear(act(linear(n, f"{layer}.mlp.fc1")), f"{layer}.mlp.fc2")
    return normed(x, "final_layer_norm")
