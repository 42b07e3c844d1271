"""Difix (nv-tlabs/Difix3D, arXiv 2503.01774): SD-Turbo run once at timestep 199 on the clean latent; its decoder sees encoder features.

The folders nvidia/difix and nvidia/difix_ref, as diffusers lays them out; UNet and autoencoder are diffusers' own classes. The decoder's
low-rank adapters are added to its weights when it is read, the prompt is encoded once. The release draws its latent at random around the
mean; here it is the mean, so that the same frame gives the same picture.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from enhance.public.clip_text import encoded, tokens
from enhance.public.layout import fill, finite
from enhance.public.model import Model

PROMPT = "remove degradation"
TIMESTEP = 199
ADAPTER = "vae_skip"
ALPHA = 8
"""Of the adapters, over their rank: peft's own choice, which the training left as it is."""


class Difix(Model):
    name = "Difix"
    multiple = 64
    takes_reference = True
    unet: Any
    vae: Any

    def __init__(self, unet: nn.Module, vae: nn.Module, text: torch.Tensor, kept: float, scale: float):
        """text `[1, N, D]`; kept: how much of a clean latent's variance is left at the timestep; scale of latents."""
        super().__init__()
        self.unet, self.vae, self.kept, self.scale = unet, vae, kept, scale
        self.text = nn.Parameter(text, requires_grad=False)

    def forward(self, clip: torch.Tensor) -> torch.Tensor:
        """One frame, or a frame and a reference view of the same place, whose tokens it then attends to as well."""
        views = clip[0] * 2 - 1
        z, features = self._encode(views)
        text = self.text.expand(len(views), -1, -1)
        noise = self.unet(z, torch.tensor(TIMESTEP, device=z.device), encoder_hidden_states=text, return_dict=False)[0]
        clean = (z[:1] - (1 - self.kept) ** 0.5 * noise[:1]) / self.kept**0.5
        return self._decode(clean, [f[:1] for f in features]) / 2 + 0.5

    def _encode(self, x: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        encoder, features = self.vae.encoder, []
        x = encoder.conv_in(x)
        for block in encoder.down_blocks:
            features.append(x)
            x = block(x)
        x = encoder.conv_out(encoder.conv_act(encoder.conv_norm_out(encoder.mid_block(x))))
        return self.vae.quant_conv(x).chunk(2, 1)[0] * self.scale, features

    def _decode(self, z: torch.Tensor, features: list[torch.Tensor]) -> torch.Tensor:
        decoder = self.vae.decoder
        x = decoder.mid_block(decoder.conv_in(self.vae.post_quant_conv(z / self.scale)))
        for i, block in enumerate(decoder.up_blocks):
            x = block(x + getattr(decoder, f"skip_conv_{i + 1}")(features[-1 - i]))
        return decoder.conv_out(decoder.conv_act(decoder.conv_norm_out(x)))


class Mixed:
    """Self-attention over the tokens of all views together, in place of each view's own (nv-tlabs/Difix3D, src/mv_unet.py)."""

    def __call__(self, attn, hidden_states: torch.Tensor, encoder_hidden_states=None, attention_mask=None, **_) -> torch.Tensor:
        views, count, _width = hidden_states.shape
        x = hidden_states.reshape(1, views * count, -1)
        q, k, v = (p(x).unflatten(-1, (attn.heads, -1)).transpose(1, 2) for p in (attn.to_q, attn.to_k, attn.to_v))
        seen = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        return attn.to_out[0](seen).reshape(views, count, -1)


def read_difix(folder: Path, read_state) -> Difix:
    """Of a folder of the release; `read_state` reads a file's tensors. ValueError as `strict`, or where diffusers is not installed."""
    try:
        from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
        from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
    except ImportError as error:
        raise ValueError(f"{folder} is Difix, which needs diffusers ({error}); pip install 'sidestep[public]'") from error
    unet_file, vae_file = (folder / name / "diffusion_pytorch_model.safetensors" for name in ("unet", "vae"))
    unet_config, vae_config = (config_of(folder / name / "config.json") for name in ("unet", "vae"))
    unet, vae = _made(UNet2DConditionModel, unet_config), _made(AutoencoderKL, vae_config)
    widths = vae_config["block_out_channels"]
    carried = zip([*widths[-2::-1], widths[0]], [widths[-1], *widths[:0:-1]], strict=True)
    with torch.device("meta"):
        for i, (inputs, outputs) in enumerate(carried):
            setattr(vae.decoder, f"skip_conv_{i + 1}", nn.Conv2d(inputs, outputs, 1, bias=False))
    fill(unet_file, "Difix's UNet", unet, read_state(unet_file))
    fill(vae_file, "Difix's autoencoder", vae, merged(vae_file, read_state(vae_file)))
    for name, module in unet.named_modules():
        if name.endswith("attn1"):
            module.set_processor(Mixed())
    text_file, text_config = folder / "text_encoder" / "model.safetensors", config_of(folder / "text_encoder" / "config.json")
    ids = tokens(folder / "tokenizer", PROMPT, int(text_config.get("max_position_embeddings", 77)))
    text = encoded(text_file, read_state(text_file), text_config, ids)
    difix = Difix(unet, vae, text, variance_kept(folder / "scheduler" / "scheduler_config.json"), vae_config["scaling_factor"])
    finite(folder, difix)
    return difix.eval().requires_grad_(False)


class Config(dict[str, Any]):
    """What a json file says, by key. ValueError naming the file for a key that it lacks."""

    def __init__(self, path: Path, found: Mapping[str, Any]):
        super().__init__(found)
        self.path = path

    def __missing__(self, key: str) -> Any:
        raise ValueError(f"{self.path} does not say {key}; fetch the model's folder again")


def config_of(path: Path) -> Config:
    """A json file's dict. ValueError where it is not there or not whole."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read ({error}); fetch the model's folder again") from error
    if not isinstance(found, dict):
        raise ValueError(f"{path} must hold an object, got a {type(found).__name__}; fetch the model's folder again")
    return Config(path, found)


def variance_kept(path: Path) -> float:
    """Of a clean latent at TIMESTEP: the product of 1 - beta so far. ValueError for a schedule that is not SD-Turbo's kind."""
    config = config_of(path)
    wanted = {"beta_schedule": "scaled_linear", "prediction_type": "epsilon", "clip_sample": False}
    for name, value in wanted.items():
        if config.get(name, value) != value:
            raise ValueError(f"{path}: {name} is {config[name]!r}, wanted {value!r} of SD-Turbo; fetch the folder again")
    steps = int(config.get("num_train_timesteps", 1000))
    if steps <= TIMESTEP:
        raise ValueError(f"{path}: num_train_timesteps is {steps}, and the release runs at step {TIMESTEP}; fetch the folder again")
    ends = float(config["beta_start"]) ** 0.5, float(config["beta_end"]) ** 0.5
    betas = torch.linspace(*ends, steps, dtype=torch.float64) ** 2
    return float((1 - betas)[: TIMESTEP + 1].prod())


def merged(path: Path, state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """`state` with its low-rank adapters added to the weights that they stand beside, and those named as without them."""
    found = {}
    for name, value in state.items():
        if f".lora_A.{ADAPTER}." in name or f".lora_B.{ADAPTER}." in name:
            if name.replace("lora_A", "lora_B") not in state or name.split(".lora_")[0] + ".base_layer.weight" not in state:
                raise ValueError(f"{path}: {name} stands alone; fetch Difix again")
            continue
        if name.endswith(".base_layer.weight"):
            layer = name.removesuffix(".base_layer.weight")
            down, up = (state.get(f"{layer}.lora_{side}.{ADAPTER}.weight") for side in "AB")
            if down is not None and up is not None:
                change = (up.float().flatten(1) @ down.float().flatten(1)).reshape(value.shape)
                value = value.float() + ALPHA / len(down) * change
        found[name.replace(".base_layer.", ".")] = value
    return found


def _made(kind, config: Mapping) -> nn.Module:
    """diffusers' class of a config, without weights. ValueError where that config is not one of its."""
    known = {name: value for name, value in config.items() if name in inspect.signature(kind.__init__).parameters}
    try:
        with torch.device("meta"):
            return kind(**known)
    except (TypeError, ValueError, IndexError, RuntimeError) as error:
        raise ValueError(f"the config of {kind.__name__} is not one that it knows ({error}); fetch the folder again") from error
