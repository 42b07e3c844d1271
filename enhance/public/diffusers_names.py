"""The names that huggingface/diffusers gives the tensors of Cosmos-Predict2 and of the Wan autoencoder, as the releases name them."""

from __future__ import annotations

import re
from collections.abc import Mapping

TRANSFORMER = (
    (r"^patch_embed\.proj", "x_embedder.proj.1"),
    (r"^time_embed\.t_embedder", "t_embedder.1"),
    (r"^time_embed\.norm", "t_embedding_norm"),
    (r"^norm_out\.linear_", "final_layer.adaln_modulation."),
    (r"^proj_out", "final_layer.linear"),
    (r"^transformer_blocks", "blocks"),
    (r"\.norm1\.linear_", ".adaln_modulation_self_attn."),
    (r"\.norm2\.linear_", ".adaln_modulation_cross_attn."),
    (r"\.norm3\.linear_", ".adaln_modulation_mlp."),
    (r"\.attn1\.", ".self_attn."),
    (r"\.attn2\.", ".cross_attn."),
    (r"\.norm_([qk])\.", r".\1_norm."),
    (r"\.to_([qkv])\.", r".\1_proj."),
    (r"\.to_out\.0\.", ".output_proj."),
    (r"\.ff\.net\.0\.proj\.", ".mlp.layer1."),
    (r"\.ff\.net\.2\.", ".mlp.layer2."),
)

AUTOENCODER = (
    (r"^quant_conv", "conv1"),
    (r"^post_quant_conv", "conv2"),
    (r"\.conv_in\.", ".conv1."),
    (r"\.norm_out\.", ".head.0."),
    (r"\.conv_out\.", ".head.2."),
    (r"\.mid_block\.resnets\.0\.", ".middle.0."),
    (r"\.mid_block\.attentions\.0\.", ".middle.1."),
    (r"\.mid_block\.resnets\.1\.", ".middle.2."),
    (r"\.down_blocks\.", ".downsamples."),
    (r"\.up_blocks\.(\d+)\.resnets\.(\d+)\.", lambda m: f".upsamples.{4 * int(m[1]) + int(m[2])}."),
    (r"\.up_blocks\.(\d+)\.upsamplers\.0\.", lambda m: f".upsamples.{4 * int(m[1]) + 3}."),
    (r"(\.(?:downsamples|upsamples|middle)\.\d+)\.norm1\.", r"\1.residual.0."),
    (r"(\.(?:downsamples|upsamples|middle)\.\d+)\.conv1\.", r"\1.residual.2."),
    (r"(\.(?:downsamples|upsamples|middle)\.\d+)\.norm2\.", r"\1.residual.3."),
    (r"(\.(?:downsamples|upsamples|middle)\.\d+)\.conv2\.", r"\1.residual.6."),
    (r"\.conv_shortcut\.", ".shortcut."),
)


def released(state: Mapping[str, object], names: tuple) -> dict[str, object]:
    """`state` with its names changed by the patterns of TRANSFORMER or AUTOENCODER, in order."""
    found = {}
    for name, value in state.items():
        for pattern, name_then in names:
            name = re.sub(pattern, name_then, name)
        found[name] = value
    return found
