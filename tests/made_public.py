"""Small random checkpoints of the public models, in the layouts and under the names of their releases, from diffusers' own classes."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
import torch

from enhance.public import diffusers_names
from enhance.public.wan import MEAN, STD

COUNTERS = ("accum_image_sample_counter", "accum_video_sample_counter", "accum_iteration", "accum_train_in_hours")


def stirred(module: torch.nn.Module, seed: int, share: float = 1.0) -> torch.nn.Module:
    """The module with every parameter random, so that none is 0 or 1 as it begins."""
    draw = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for value in module.parameters():
            value.add_(torch.randn(value.shape, generator=draw) * share / max(value[0].numel(), 1) ** 0.5 if value.ndim > 1 else
                       0.1 * torch.randn(value.shape, generator=draw))  # fmt: skip
    return module.eval()


def cosmos(seed: int = 0, masks: int = 1):
    """diffusers' transformer: 2 blocks, 2 heads of 24. The mask channels are ordinary channels of it, as torchvision would be needed."""
    module = pytest.importorskip("diffusers.models.transformers.transformer_cosmos", reason="diffusers is not installed")
    torch.manual_seed(seed)
    stretch = 4.0 if masks == 1 else 3.0
    net = module.CosmosTransformer3DModel(
        in_channels=16 + masks, out_channels=16, num_attention_heads=2, attention_head_dim=24, num_layers=2, mlp_ratio=2.0,
        text_embed_dim=20, adaln_lora_dim=8, rope_scale=(1.0, stretch, stretch), concat_padding_mask=False, extra_pos_embed_type=None,
    )  # fmt: skip
    return stirred(net, seed)


def wan(seed: int = 0):
    """diffusers' autoencoder, 12 times narrower."""
    module = pytest.importorskip("diffusers.models.autoencoders.autoencoder_kl_wan", reason="diffusers is not installed")
    torch.manual_seed(seed)
    return stirred(module.AutoencoderKLWan(base_dim=8, z_dim=16, latents_mean=list(MEAN), latents_std=list(STD)), seed, 0.5)


def transformer_state(net) -> dict[str, torch.Tensor]:
    """As `MiniTrainDIT.state_dict()` names it, with its counters and tables."""
    state = diffusers_names.released(net.state_dict(), diffusers_names.TRANSFORMER)
    head = net.config.attention_head_dim
    sides = {"seq": 128, "dim_spatial_range": head // 6, "dim_temporal_range": head // 2 - 2 * (head // 6)}
    return state | {f"pos_embedder.{k}": torch.rand(n) for k, n in sides.items()} | {name: torch.tensor(0) for name in COUNTERS}


def autoencoder_state(vae) -> dict[str, torch.Tensor]:
    """As `Wan2.1_VAE.pth` names it."""
    return diffusers_names.released(vae.state_dict(), diffusers_names.AUTOENCODER)


def prefixed(prefix: str, state: dict) -> dict:
    return {f"{prefix}{name}": value for name, value in state.items()}


def harmonizer(path: Path, net, vae, **more) -> Path:
    """A `diffusion_harmonizer.pkl`, as `save_ckpt` of NVIDIA/harmonizer writes it, with the running mean that the legacy ones hold too."""
    live = transformer_state(net)
    unet = prefixed("net.", live) | prefixed("net_ema.", live)
    parts = {"state_dict_unet": unet, "state_dict_vae": autoencoder_state(vae), "net_disc": None, "optimizer": {"state": {}}}
    torch.save(parts | {"optimizer_disc": None} | more, path)
    return path


def base(folder: Path, net, vae) -> Path:
    """The folder of nvidia/Cosmos-Predict2-0.6B-Text2Image, with what Transformer Engine leaves in a state dict."""
    (folder / "tokenizer").mkdir(parents=True)
    engine = {"blocks.0.self_attn.attn_op._extra_state": io.BytesIO(b"some"), "t_embedding_norm._extra_state": torch.zeros(0).byte()}
    torch.save(prefixed("net.", transformer_state(net) | engine), folder / "model.pt")
    torch.save(autoencoder_state(vae), folder / "tokenizer" / "tokenizer.pth")
    return folder


RANK = 2


def adapted(vae: torch.nn.Module, seed: int = 0) -> dict[str, torch.Tensor]:
    """A Difix autoencoder's tensors: peft's names, with adapters of RANK on the decoder's convolutions and projections."""
    draw, found = torch.Generator().manual_seed(seed), {}
    for name, value in vae.state_dict().items():
        layer, kind = name.rsplit(".", 1)
        adapts = layer.startswith("decoder.") and layer.rsplit(".", 1)[1].startswith(("conv1", "conv_in", "conv_out", "skip", "to_q"))
        found[f"{layer}.base_layer.{kind}" if adapts else name] = value
        if adapts and kind == "weight":
            down, up = (RANK, *value.shape[1:]), (value.shape[0], RANK, *(1 for _ in value.shape[2:]))
            for side, shape in zip("AB", (down, up), strict=True):
                found[f"{layer}.lora_{side}.vae_skip.weight"] = 0.1 * torch.randn(shape, generator=draw)
    return found


def difix(folder: Path) -> tuple[Path, torch.nn.Module, torch.nn.Module]:
    """The folder of nvidia/difix, small; its UNet and its autoencoder without adapters."""
    pytest.importorskip("diffusers", reason="diffusers is not installed")
    from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
    from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
    from safetensors.torch import save_file

    sizes = {"block_out_channels": [16, 32, 32, 32], "layers_per_block": 1, "norm_num_groups": 8}
    unet_config = sizes | {"cross_attention_dim": 12, "attention_head_dim": [2, 4, 4, 4], "use_linear_projection": True, "sample_size": 8}
    blocks = {"down_block_types": 4 * ["DownEncoderBlock2D"], "up_block_types": 4 * ["UpDecoderBlock2D"], "latent_channels": 4}
    vae_config = sizes | blocks | {"scaling_factor": 0.18215}
    torch.manual_seed(0)
    unet, vae = stirred(UNet2DConditionModel(**unet_config), 1, 0.3), AutoencoderKL(**vae_config)
    for i, (inputs, outputs) in enumerate([(32, 32), (32, 32), (16, 32), (16, 32)]):
        setattr(vae.decoder, f"skip_conv_{i + 1}", torch.nn.Conv2d(inputs, outputs, 1, bias=False))
    stirred(vae, 2, 0.3)
    width, inner, words = 12, 20, ["!", "<|startoftext|>", "<|endoftext|>", "remove</w>", "de", "gradation</w>", "removal</w>"]
    text = {"embeddings.token_embedding.weight": (len(words), width), "embeddings.position_embedding.weight": (77, width)}
    for i in range(2):
        layer = {f"self_attn.{n}_proj": (width, width) for n in ("q", "k", "v", "out")} | {"mlp.fc1": (inner, width)}
        for name, shape in (layer | {"mlp.fc2": (width, inner), "layer_norm1": (width,), "layer_norm2": (width,)}).items():
            text |= {f"encoder.layers.{i}.{name}.weight": shape, f"encoder.layers.{i}.{name}.bias": shape[:1]}
    text |= {"final_layer_norm.weight": (width,), "final_layer_norm.bias": (width,)}
    tensors = {
        "unet/diffusion_pytorch_model": unet.state_dict(),
        "vae/diffusion_pytorch_model": adapted(vae),
        "text_encoder/model": {f"text_model.{name}": torch.randn(shape) for name, shape in text.items()},
    }
    for name, state in tensors.items():
        (folder / name).parent.mkdir(parents=True)
        save_file({k: v.contiguous() for k, v in state.items()}, folder / f"{name}.safetensors")
    betas = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear", "clip_sample": False, "prediction_type": "epsilon"}
    clip = {"num_attention_heads": 3, "intermediate_size": inner, "hidden_act": "gelu", "max_position_embeddings": 77}
    special = {"bos_token": {"content": words[1]}, "eos_token": {"content": words[2]}, "pad_token": "!"}
    merges = ["#version: 0.2", *(["r e", "re m", "rem o", "remo v", "remov e</w>", "d e"]), *_merges("gradation")]
    configs = {"unet/config": unet_config, "vae/config": vae_config | {"gamma": 1.0, "ignore_skip": False, "lora_rank": RANK}}
    configs |= {"scheduler/scheduler_config": betas, "text_encoder/config": clip, "tokenizer/special_tokens_map": special}
    configs["tokenizer/vocab"] = {word: i for i, word in enumerate(words)}
    for name, config in configs.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / f"{name}.json").write_text(json.dumps(config))
    (folder / "tokenizer" / "merges.txt").write_text("\n".join(merges) + "\n")
    return folder, unet, vae.eval()


def _merges(word: str) -> list[str]:
    """Merges that build a word from its left."""
    pieces = [*word[:-1], word[-1] + "</w>"]
    return [f"{''.join(pieces[:i])} {pieces[i]}" for i in range(1, len(pieces))]
