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
    """A convolution that sees no later frame, as the release holds it; `Taps` is what runs."""

    def __init__(self, inputs: int, outputs: int, kernel: int, over_time: bool = False):
        plane = 1 if over_time else kernel
        super().__init__(inputs, outputs, (kernel, plane, plane))


class Taps(nn.Module):
    """A causal convolution as one in the plane for each frame that it looks back.

    Those that would look before the first frame meet zeros and are left out, exactly: of a first frame only the last is left, and only
    that is kept where nothing but first frames comes.
    """

    def __init__(self, conv: Causal, looks_back: bool):
        super().__init__()
        taps = conv.weight.unbind(2)
        self.taps = nn.ParameterList([nn.Parameter(w.clone(), requires_grad=False) for w in (taps if looks_back else taps[-1:])])
        self.bias = conv.bias

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """`[T, C, H, W]`, the frames of one clip in order, to as many."""
        *earlier, now = self.taps
        side = now.shape[-1] // 2
        y = F.conv2d(x, now, self.bias, padding=side)
        for back, tap in enumerate(reversed(earlier), 1):
            if back < len(x):
                y[back:] += F.conv2d(x[:-back], tap, padding=side)
        return y

    def thinned(self, x: torch.Tensor) -> torch.Tensor:
        """`[T, C, H, W]` to (T - 1) / 2 frames, each of three neighbours."""
        first, second, third = (F.conv2d(x[k : len(x) - 2 + k : 2], tap) for k, tap in enumerate(self.taps))
        assert self.bias is not None
        return first + second + third + self.bias.view(-1, 1, 1)


class Norm(nn.Module):
    """Channels scaled to their root mean square; `sides` of its weight: those of a picture, or of a clip."""

    def __init__(self, width: int, sides: int = 3):
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width, *(sides * [1])))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return F.normalize(x, dim=1) * (x.shape[1] ** 0.5 * self.gamma.view(-1, 1, 1))


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
        self.norm = Norm(width, 2)
        self.to_qkv = nn.Conv2d(width, 3 * width, 1)
        self.proj = nn.Conv2d(width, width, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        q, k, v = self.to_qkv(self.norm(x)).flatten(2).transpose(1, 2)[:, None].chunk(3, dim=-1)
        seen = F.scaled_dot_product_attention(q.contiguous(), k.contiguous(), v.contiguous())[:, 0]
        return x + self.proj(seen.transpose(1, 2).unflatten(2, x.shape[2:]))


class Shrink(nn.Module):
    """Sides halved; frames thinned by two after the first, if `thinned`."""

    def __init__(self, width: int, thinned: bool):
        super().__init__()
        self.resample = nn.Sequential(nn.ZeroPad2d((0, 1, 0, 1)), nn.Conv2d(width, width, 3, stride=2))
        if thinned:
            self.time_conv = Causal(width, width, 3, over_time=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x, over_time = self.resample(x), getattr(self, "time_conv", None)
        return torch.cat([x[:1], over_time.thinned(x)]) if len(x) > 1 and isinstance(over_time, Taps) else x


class Grow(nn.Module):
    """Sides doubled. `time_conv` makes two frames of each after the first, which are never decoded here; it is read and let go."""

    def __init__(self, width: int, thinned: bool):
        super().__init__()
        self.resample = nn.Sequential(nn.Upsample(scale_factor=2.0, mode="nearest-exact"), nn.Conv2d(width, width // 2, 3, padding=1))
        if thinned:
            self.time_conv = Causal(width, 2 * width, 3, over_time=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.resample(x)


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
        """Frames `[T, 3, H, W]` to moments `[t, 32, H/8, W/8]`, and the layers' features."""
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
        """Latents `[1, 16, h, w]` to `[1, 3, 8 h, 8 w]`; the encoder's `features`, whose first frame is carried over."""
        x, order = self.middle(self.conv1(z)), list(SKIPPED)
        for i, layer in enumerate(self.upsamples):
            if self.skips and i in SKIPPED:
                carry = getattr(self, f"skip_conv_{order.index(i)}")
                x = x + F.conv2d(features[::-1][SKIPPED[i]][:1], carry.weight[:, :, 0])
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
    def read(cls, path: Path, state: Mapping[str, object], single: bool = False) -> Autoencoder:
        """From the released tensors, in float32; `single`: for clips of one frame only. ValueError as `strict`."""
        width = shape_of(path, NAME, state, "encoder.conv1.weight", 5)[0]
        with torch.device("meta"):
            vae = cls(width, any(name.startswith("decoder.skip_conv_") for name in state))
        fill(path, NAME, vae, state)
        for layer in vae.decoder.upsamples:
            if hasattr(layer, "time_conv"):
                del layer.time_conv
        _settle(vae.encoder, looks_back=not single)
        _settle(vae, looks_back=False)
        for name, values in (("mean", MEAN), ("std", STD)):
            vae.register_buffer(name, torch.tensor(values).view(1, LATENT, 1, 1))
        finite(path, vae)
        return vae.eval().requires_grad_(False)

    def encode(self, clip: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """`[1, 3, 1 + 4n, H, W]` in -1..1, sides multiples of 8, to latents `[1, 16, 1 + n, H/8, W/8]` of about mean 0 and deviation 1;
        and the features that `decode` takes."""
        frames = clip[0].transpose(0, 1).contiguous(memory_format=torch.channels_last)
        moments, features = self.encoder(frames)
        return ((self.conv1(moments)[:, :LATENT] - self.mean) / self.std).transpose(0, 1)[None], features

    def decode(self, latents: torch.Tensor, features: list[torch.Tensor]) -> torch.Tensor:
        """The first frame `[1, 3, H, W]`, about -1..1, of latents `[1, 16, t, H/8, W/8]`: later latents cannot change it."""
        first = latents[:, :, 0].contiguous(memory_format=torch.channels_last)
        return self.decoder(self.conv2(first * self.std + self.mean), features)


def _settle(module: nn.Module, looks_back: bool) -> None:
    """Put what runs in place of what the release holds."""
    for name, layer in module.named_children():
        if isinstance(layer, Causal):
            setattr(module, name, Taps(layer, looks_back))
        else:
            _settle(layer, looks_back)
