"""The Wan 2.1 autoencoder (Wan-Video/Wan2.1, vae.py; the tokenizer of Cosmos-Predict2), for one frame and what is seen before it.

Modules are named as in the released `tokenizer.pth` and `Wan2.1_VAE.pth`. Videos are encoded whole, not in chunks with caches: over 1 + 4n
frames that is the same. Only a video's first frame is ever decoded, so nothing of the decoder looks back in time.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import nn
from torch.nn import functional as F

from enhance.public.layout import fill, finite, shape_of

NAME = "the Wan 2.1 autoencoder"
LATENT = 16
STRIDE = 8
WIDTHS = (1, 2, 4, 4)
THINNED = (False, True, True)
"""Whether each halving of the picture's sides also thins frames by two."""

MEAN = (-0.7571, -0.7089, -0.9113, 0.1075, -0.1745, 0.9653, -0.1517, 1.5508, 0.4134, -0.0715, 0.5517, -0.3632,
        -0.1922, -0.9497, 0.2503, -0.2921)  # fmt: skip
STD = (2.8184, 1.4541, 2.3275, 2.6558, 1.2196, 1.7708, 2.6052, 2.0743, 3.2687, 2.1526, 2.8652, 1.5579, 1.6382, 1.1253, 2.8251, 1.9160)
"""Of the latents, as published with the autoencoder: it is not in its file."""

SKIPS = (4, 4, 4, 4, 4, 2, 2, 1, 1)
"""Widths of the convolutions that carry the encoder's features over to the decoder, where a release has them."""

SKIPPED = {0: 0, 1: 1, 2: 2, 5: 3, 6: 4, 8: 6, 10: 7, 12: 9, 14: 10}
"""Decoder layer: the encoder layer, counted from its end, whose output is added before it."""


class Causal(nn.Conv3d):
    """A convolution that sees no later frame. Over a first frame the taps that would see earlier ones meet zeros: there it is the last
    tap's convolution in the plane, exactly."""

    def __init__(self, inputs: int, outputs: int, kernel: int, over_time: bool = False):
        plane = 1 if over_time else kernel
        super().__init__(inputs, outputs, (kernel, plane, plane))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """`[B, C, T, H, W]` to as many frames of the same size."""
        taps, side = self.weight.shape[2], self.weight.shape[3] // 2
        if taps > 1 and x.shape[2] > 1:
            return F.conv3d(F.pad(x, (side, side, side, side, taps - 1, 0)), self.weight, self.bias)
        flat = F.conv2d(x.transpose(1, 2).flatten(0, 1), self.weight[:, :, -1], self.bias, padding=side)
        return flat.unflatten(0, (x.shape[0], x.shape[2])).transpose(1, 2)


class Norm(nn.Module):
    """Channels scaled to their root mean square; `planes`: over `[B, C, H, W]`, over `[B, C, T, H, W]` otherwise."""

    def __init__(self, width: int, planes: bool = False):
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width, *((1, 1) if planes else (1, 1, 1))))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return F.normalize(x, dim=1) * (x.shape[1] ** 0.5 * self.gamma)


class Residual(nn.Module):
    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        first, second = Causal(inputs, outputs, 3), Causal(outputs, outputs, 3)
        self.residual = nn.Sequential(Norm(inputs), nn.SiLU(), first, Norm(outputs), nn.SiLU(), nn.Identity(), second)
        self.shortcut = Causal(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.residual(x) + self.shortcut(x)


class Attention(nn.Module):
    """One head over each frame by itself."""

    def __init__(self, width: int):
        super().__init__()
        self.norm = Norm(width, planes=True)
        self.to_qkv = nn.Conv2d(width, 3 * width, 1)
        self.proj = nn.Conv2d(width, width, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        b, c, t, h, w = x.shape
        frames = x.transpose(1, 2).flatten(0, 1)
        q, k, v = self.to_qkv(self.norm(frames)).flatten(2).transpose(1, 2)[:, None].chunk(3, dim=-1)
        seen = F.scaled_dot_product_attention(q.contiguous(), k.contiguous(), v.contiguous())[:, 0]
        return x + self.proj(seen.transpose(1, 2).unflatten(2, (h, w))).unflatten(0, (b, t)).transpose(1, 2)


class Shrink(nn.Module):
    """Sides halved; frames thinned by two after the first, if `thinned`."""

    def __init__(self, width: int, thinned: bool):
        super().__init__()
        self.resample = nn.Sequential(nn.ZeroPad2d((0, 1, 0, 1)), nn.Conv2d(width, width, 3, stride=2))
        if thinned:
            self.time_conv = Causal(width, width, 3, over_time=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = _by_frame(self.resample, x)
        if x.shape[2] == 1 or not hasattr(self, "time_conv"):
            return x
        later = F.conv3d(x, self.time_conv.weight, self.time_conv.bias, stride=(2, 1, 1))
        return torch.cat([x[:, :, :1], later], 2)


class Grow(nn.Module):
    """Sides doubled. `time_conv` makes two frames of each after the first, which are never decoded here; it is read and let go."""

    def __init__(self, width: int, thinned: bool):
        super().__init__()
        self.resample = nn.Sequential(nn.Upsample(scale_factor=2.0, mode="nearest-exact"), nn.Conv2d(width, width // 2, 3, padding=1))
        if thinned:
            self.time_conv = Causal(width, 2 * width, 3, over_time=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return _by_frame(self.resample, x)


def _by_frame(module: nn.Module, x: torch.Tensor) -> torch.Tensor:
    return module(x.transpose(1, 2).flatten(0, 1)).unflatten(0, (x.shape[0], x.shape[2])).transpose(1, 2)


class Encoder(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        widths = [width * m for m in (1, *WIDTHS)]
        self.conv1 = Causal(3, width, 3)
        layers: list[nn.Module] = []
        for i, (inputs, outputs) in enumerate(zip(widths, widths[1:], strict=False)):
            layers += [Residual(inputs, outputs), Residual(outputs, outputs)]
            if i < len(THINNED):
                layers.append(Shrink(outputs, THINNED[i]))
        self.downsamples = nn.Sequential(*layers)
        self.middle = nn.Sequential(Residual(outputs, outputs), Attention(outputs), Residual(outputs, outputs))
        self.head = nn.Sequential(Norm(outputs), nn.SiLU(), Causal(outputs, 2 * LATENT, 3))

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Moments `[B, 32, t, H/8, W/8]`, and the layers' features."""
        x, features = self.conv1(x), []
        for layer in self.downsamples:
            x = layer(x)
            features.append(x)
        return self.head(self.middle(x)), features


class Decoder(nn.Module):
    def __init__(self, width: int, skips: bool):
        super().__init__()
        widths = [width * m for m in (WIDTHS[-1], *reversed(WIDTHS))]
        self.conv1 = Causal(LATENT, widths[0], 3)
        self.middle = nn.Sequential(Residual(widths[0], widths[0]), Attention(widths[0]), Residual(widths[0], widths[0]))
        layers: list[nn.Module] = []
        for i, outputs in enumerate(widths[1:]):
            inputs = widths[i] // 2 if i else widths[i]
            layers += [Residual(inputs, outputs), Residual(outputs, outputs), Residual(outputs, outputs)]
            if i < len(THINNED):
                layers.append(Grow(outputs, THINNED[::-1][i]))
        self.upsamples = nn.Sequential(*layers)
        self.head = nn.Sequential(Norm(width), nn.SiLU(), Causal(width, 3, 3))
        self.skips = skips
        for i, m in enumerate(SKIPS if skips else ()):
            setattr(self, f"skip_conv_{i}", nn.Conv3d(width * m, width * m, 1, bias=False))

    def forward(self, z: torch.Tensor, features: list[torch.Tensor]) -> torch.Tensor:
        """Latents `[B, 16, 1, h, w]` to `[B, 3, 1, 8 h, 8 w]`; `features` of the encoder's first frame."""
        x, order = self.middle(self.conv1(z)), list(SKIPPED)
        for i, layer in enumerate(self.upsamples):
            if self.skips and i in SKIPPED:
                carry = getattr(self, f"skip_conv_{order.index(i)}")
                x = x + carry(features[::-1][SKIPPED[i]][:, :, :1])
            x = layer(x)
        return self.head(x)


class Autoencoder(nn.Module):
    """`encode` a clip, `decode` its first frame."""

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self, width: int, skips: bool = False):
        super().__init__()
        self.encoder, self.decoder = Encoder(width), Decoder(width, skips)
        self.conv1, self.conv2 = Causal(2 * LATENT, 2 * LATENT, 1), Causal(LATENT, LATENT, 1)

    @classmethod
    def read(cls, path: Path, state: Mapping[str, object]) -> Autoencoder:
        """From the released tensors, in float32. ValueError as `strict`."""
        width = shape_of(path, NAME, state, "encoder.conv1.weight", 5)[0]
        with torch.device("meta"):
            vae = cls(width, any(name.startswith("decoder.skip_conv_") for name in state))
        fill(path, NAME, vae, state)
        for layer in vae.decoder.upsamples:
            if hasattr(layer, "time_conv"):
                del layer.time_conv
        _flatten(vae.decoder)
        for name, values in (("mean", MEAN), ("std", STD)):
            vae.register_buffer(name, torch.tensor(values).view(1, LATENT, 1, 1, 1))
        finite(path, vae)
        return vae.eval().requires_grad_(False)

    def single(self) -> Autoencoder:
        """For clips of one frame only: nothing of the encoder looks back either."""
        for layer in self.encoder.downsamples:
            if hasattr(layer, "time_conv"):
                del layer.time_conv
        _flatten(self.encoder)
        return self

    def encode(self, clip: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """`[B, 3, 1 + 4n, H, W]` in -1..1, sides multiples of 8, to latents `[B, 16, 1 + n, H/8, W/8]` of about mean 0 and deviation 1;
        and the features that `decode` takes."""
        moments, features = self.encoder(clip)
        return (self.conv1(moments)[:, :LATENT] - self.mean) / self.std, features

    def decode(self, latents: torch.Tensor, features: list[torch.Tensor]) -> torch.Tensor:
        """The first frame `[B, 3, H, W]`, about -1..1, of latents `[B, 16, t, H/8, W/8]`: later latents cannot change it."""
        return self.decoder(self.conv2(latents[:, :, :1] * self.std + self.mean), features)[:, :, 0]


def _flatten(module: nn.Module) -> None:
    """Keep of each causal convolution what meets a first frame."""
    for layer in module.modules():
        if isinstance(layer, Causal):
            layer.weight = nn.Parameter(layer.weight[:, :, -1:].clone(), requires_grad=False)
