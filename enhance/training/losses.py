"""What training minimises: distance to the target, a perceptual distance on random patches, and flicker along exact flow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from enhance.checkpoints import read_state
from enhance.network.autoencoder import Encoder
from render.warp import warp


def pixel_loss(out: torch.Tensor, target: torch.Tensor, logarithm: float) -> torch.Tensor:
    """Mean absolute error of `out` to `target` `[B, 3, H, W]`, and a little of the `logarithm` of the squared error (PSNR), which keeps
    strong damage from outweighing the slight. It is floored at 35 dB: with a lower floor the gradient of what is nearly right drowns all
    others, and the network learns to do nothing."""
    error = out - target
    absolute = error.abs().mean()
    return absolute + logarithm * torch.log(error.square().mean((1, 2, 3)) + 3e-4).mean() if logarithm else absolute


def flicker(
    out: torch.Tensor, previous: torch.Tensor, target: torch.Tensor, before: torch.Tensor, flow: torch.Tensor, visible: torch.Tensor
) -> torch.Tensor:
    """Mean absolute difference, on `visible` pixels, of how `out` changed against the `previous` output moved here along `flow`, to how the
    `target` changed against the one `before`: photos change, too, and a picture that may not is blurred."""
    moved, inside = warp(torch.cat([previous, before], 1), flow)
    weight = visible * inside
    return (((out - moved[:, :3]) - (target - moved[:, 3:])).abs() * weight).sum() / (weight.sum() * 3).clamp_min(1)


class PatchPerceptual(nn.Module):
    """Distance of normalised features on one random square patch, at two scales.

    The features are those of a local VGG-16 file in torchvision's layout where there is one, and those of our own frozen
    autoencoder otherwise. The latter is not LPIPS and is never called so.
    """

    def __init__(self, encoder: Encoder, vgg: str | Path | None = None):
        super().__init__()
        self.features = Vgg(vgg) if vgg else _EncoderFeatures(encoder)
        self.requires_grad_(False)

    def forward(self, out: torch.Tensor, target: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
        side = min(out.shape[-2:])
        n = max(16, int(rng.uniform(side / 3, side)) // 16 * 16)
        top, left = (int(rng.integers(size - n + 1)) for size in out.shape[-2:])
        out, target = (x[..., top : top + n, left : left + n] for x in (out, target))
        total = out.new_zeros(())
        for scale in (1, 2) if n >= 32 else (1,):
            if scale > 1:
                n2 = n // scale // 16 * 16
                out, target = (F.interpolate(x, (n2, n2), mode="area") for x in (out, target))
            with torch.no_grad():
                wanted = self.features(target)
            for a, b in zip(self.features(out), wanted, strict=True):
                total = total + (F.normalize(a.float(), dim=1) - F.normalize(b.float(), dim=1)).square().sum(1).mean()
        return total


class _EncoderFeatures(nn.Module):
    def __init__(self, encoder: Encoder):
        super().__init__()
        self.encoder = [encoder]  # in a list: the encoder is the network's, not this module's

    def forward(self, rgb: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return self.encoder[0].features(rgb)[:2]


class Vgg(nn.Module):
    """VGG-16 up to relu4_3 from a local file of torchvision's `vgg16` (safetensors or a state dict). ValueError for another file."""

    WIDTHS = ((3, 64, 64), (64, 128, 128), (128, 256, 256, 256), (256, 512, 512, 512))

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self, path: str | Path):
        super().__init__()
        state = read_state(Path(path))
        self.stages = nn.ModuleList()
        index = 0
        for widths in self.WIDTHS:
            stage = nn.Sequential()
            for a, b in zip(widths, widths[1:], strict=False):
                conv = nn.Conv2d(a, b, 3, padding=1)
                for name in ("weight", "bias"):
                    key = f"features.{index}.{name}"
                    if key not in state or state[key].shape != getattr(conv, name).shape:
                        raise ValueError(f"{path} is not torchvision's vgg16: {key} is missing or has another shape; fetch that file")
                    getattr(conv, name).data.copy_(state[key])
                stage.extend([conv, nn.ReLU()])
                index += 2
            self.stages.append(stage)
            index += 1
        self.register_buffer("mean", torch.tensor([0.485, 0.456, 0.406])[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor([0.229, 0.224, 0.225])[:, None, None], persistent=False)

    def forward(self, rgb: torch.Tensor) -> list[torch.Tensor]:
        x, found = (rgb - self.mean) / self.std, []
        for i, stage in enumerate(self.stages):
            x = F.max_pool2d(x, 2) if i else x
            x = stage(x)
            found.append(x)
        return found
