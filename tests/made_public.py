"""Small random checkpoints of the public models, in the layouts and under the names of their releases, from diffusers' own classes."""

from __future__ import annotations

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
    stretch = 4.0 if masks == 1 else 3.0
    net = module.CosmosTransformer3DModel(
        in_channels=16 + masks, out_channels=16, num_attention_heads=2, attention_head_dim=24, num_layers=2, mlp_ratio=2.0,
        text_embed_dim=20, adaln_lora_dim=8, rope_scale=(1.0, stretch, stretch), concat_padding_mask=False, extra_pos_embed_type=None,
    )  # fmt: skip
    return stirred(net, seed)


def wan(seed: int = 0):
    """diffusers' autoencoder, 12 times narrower."""
    module = pytest.importorskip("diffusers.models.autoencoders.autoencoder_kl_wan", reason="diffusers is not installed")
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
    """The folder of nvidia/Cosmos-Predict2-0.6B-Text2Image."""
    (folder / "tokenizer").mkdir(parents=True)
    torch.save(prefixed("net.", transformer_state(net)), folder / "model.pt")
    torch.save(autoencoder_state(vae), folder / "tokenizer" / "tokenizer.pth")
    return folder
