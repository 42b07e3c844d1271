"""NVIDIA Harmonizer (arXiv 2602.24096), NVIDIA Fixer and their base, Cosmos-Predict2 0.6B: encode, denoise once, decode.

Noise against signal is 0.25, their timestep 250 of 1000; no noise is added. Harmonizer sees the current frame and its own four last results
as one clip of five, newest first, as `inference_pix2pix_turbo_harmonizer.py` does: two latents, of which the first is decoded.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import nn

from enhance.public.cosmos import LATENT, PATCH, Denoiser
from enhance.public.layout import fill, finite, part, strict
from enhance.public.model import Model
from enhance.public.wan import STRIDE, Autoencoder

FIXER_BESIDE = r"(net|dit)_ema\..*|tokenizer\..*"
"""What a Fixer or Harmonizer writes beside the live transformer: its running mean, and the tokenizer a second time."""

TOKENIZER = "the image tokenizer of Fixer (base/tokenizer_fast.pth)"
RELEASED = (576, 1024)
"""Rows and columns that Harmonizer and Fixer were trained and exported for."""


class Cosmos(Model):
    """A transformer between the Wan autoencoder's halves."""

    multiple = STRIDE * PATCH

    def __init__(self, name: str, net: Denoiser, vae: Autoencoder, history: int):
        super().__init__()
        self.name, self.history = name, history
        self.net, self.vae = net, vae

    def forward(self, clip: torch.Tensor) -> torch.Tensor:
        """`[1, V, 3, H, W]` in 0..1, newest first, V 1 or 5, sides multiples of 16, to the first frame `[1, 3, H, W]`."""
        latents, features = self.vae.encode(clip.transpose(1, 2) * 2 - 1)
        return self.vae.decode(self.net(latents), features) / 2 + 0.5


class Fixer(Model):
    """A transformer between a TorchScript tokenizer's halves, for single frames."""

    name = "NVIDIA Fixer"
    multiple = STRIDE * PATCH

    def __init__(self, net: Denoiser, encoder: nn.Module, decoder: nn.Module, mean: torch.Tensor, std: torch.Tensor):
        """mean, std `[16]` of the latents."""
        super().__init__()
        self.net, self.encoder, self.decoder = net, encoder, decoder
        self.register_buffer("mean", mean.float().view(1, LATENT, 1, 1))
        self.register_buffer("std", std.float().view(1, LATENT, 1, 1))

    def forward(self, clip: torch.Tensor) -> torch.Tensor:
        latent = self.encoder(clip[:, 0] * 2 - 1)
        latent = latent[0] if isinstance(latent, tuple) else latent
        better = self.net(((latent - self.mean) / self.std)[:, :, None])[:, :, 0]
        return self.decoder(better * self.std + self.mean) / 2 + 0.5


class Scripted(Model):
    """A whole model exported to TorchScript, as `harmonizer_nontemporal.pt`: pictures in -1..1 of the size that it was exported for."""

    name = "NVIDIA Harmonizer (TorchScript)"
    multiple = 1
    window = RELEASED

    def __init__(self, path: Path, module: torch.jit.ScriptModule):
        super().__init__()
        self.path, self.module = path, module

    def forward(self, clip: torch.Tensor) -> torch.Tensor:
        try:
            out = self.module(clip[:, 0] * 2 - 1)
        except RuntimeError as error:
            last = str(error).strip().splitlines()[-1]
            raise ValueError(f"{self.path} does not run on {clip.device} with {tuple(clip[:, 0].shape)} ({last}); it was exported "
                             "for a GPU, or takes something else: use the .pkl of the same release") from error  # fmt: skip
        if not isinstance(out, torch.Tensor) or out.shape != clip[:, 0].shape:
            got = tuple(out.shape) if isinstance(out, torch.Tensor) else type(out).__name__
            raise ValueError(f"{self.path} returns {got} for {tuple(clip[:, 0].shape)}; use the .pkl of the same release")
        return out / 2 + 0.5


def live(state: Mapping[str, object]) -> dict[str, object]:
    """The live transformer's tensors of a release, named without `net.` or `dit.`; what is neither it nor known to stand beside it stays
    in and is refused by name."""
    for prefix in ("net.", "dit."):
        if any(name.startswith(prefix) for name in state):
            rest = {n: v for n, v in state.items() if not n.startswith(prefix) and not re.fullmatch(FIXER_BESIDE, n)}
            return part(state, prefix) | rest
    return dict(state)


def read_cosmos(path: Path, transformer: Mapping[str, object], vae: Mapping[str, object], name: str, history: int) -> Cosmos:
    """Of released tensors. ValueError as `strict`."""
    return Cosmos(name, Denoiser.read(path, live(transformer)), Autoencoder.read(path, vae, single=history == 0), history)


def read_fixer(path: Path, transformer: Mapping[str, object], vae: Mapping[str, object], tokenizer: Path, kept: Mapping) -> Fixer:
    """Of a Fixer's tensors and its base's tokenizer file, read as `kept`: TorchScript of both halves, mean and deviation."""
    if set(kept) != {"encoder", "decoder", "mean_std"}:
        raise ValueError(f"{tokenizer} holds {', '.join(map(str, kept))}, not encoder, decoder, mean_std; fetch {TOKENIZER} again")
    halves = []
    for half in ("encoder", "decoder"):
        try:
            module = torch.jit.load(io.BytesIO(kept[half]), map_location="cpu").float().eval()
        except (RuntimeError, TypeError) as error:
            raise ValueError(f"{tokenizer}: its {half} is not a valid TorchScript; fetch {TOKENIZER} again") from error
        fill(path, f"the {half} of {TOKENIZER}", module, part(vae, f"{half}."), assign=False)
        halves.append(module)
    others = [name for name in vae if not name.startswith(("encoder.", "decoder."))]
    strict(path, TOKENIZER, {name: vae[name] for name in others}, {})
    mean, std = kept["mean_std"]
    if mean.numel() != LATENT or std.numel() != LATENT:
        raise ValueError(f"{tokenizer}: mean and deviation of {mean.numel()} and {std.numel()} channels, wanted {LATENT}; fetch it again")
    fixer = Fixer(Denoiser.read(path, live(transformer)), halves[0], halves[1], mean.float(), std.float())
    finite(path, fixer)
    return fixer.eval().requires_grad_(False)
