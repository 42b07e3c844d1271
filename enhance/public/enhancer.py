"""A public model behind the call that every enhancer has."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch.nn import functional as F

from enhance.alike import alike
from enhance.network.precision import channels_last, has_bfloat16
from enhance.public.model import Model
from enhance.step import checked
from render.frame_types import Frame

LARGEST = 1280
"""Pixels a side that a model without a size of its own sees at once: attention over more costs more than twice for twice."""

OVERLAP = 64
"""Pixels that neighbouring parts of a larger frame share at least; they are blended there."""


@dataclass(frozen=True)
class Recent:
    """The last frame as it was given, and the last results, newest first; `[H, W, 3]` each."""

    given: torch.Tensor
    frames: tuple[torch.Tensor, ...]


class PublicEnhancer:
    """`better, memory = enhancer.step(frame, memory)`, as `Enhancer`; the model redraws every pixel, needed or not."""

    reads: tuple[str, ...] = ()

    def __init__(
        self,
        model: Model,
        about: dict | None = None,
        device: str | torch.device = "cpu",
        bfloat16: bool | None = None,
        history: int | None = None,
        reference: torch.Tensor | None = None,
    ):
        """bfloat16: whether to compute in it; where that is fast, if None. history: results that the model takes beside the frame, 0 or
        its own number; that, if None. reference `[H, W, 3]` in 0..1: a clean picture of about the same view, for a model that takes
        one (Difix with reference)."""
        self.device = torch.device(device)
        self.bfloat16 = has_bfloat16(self.device) if bfloat16 is None else bfloat16
        self.model = channels_last(model.eval().to(self.device, torch.bfloat16 if self.bfloat16 else torch.float32))
        self.about = about or {}
        self.history = model.history if history is None else history
        self.reference = None if reference is None else checked(reference).rgb.to(self.device, torch.float32).clamp(0, 1)
        if reference is not None and not model.takes_reference:
            raise ValueError(f"{model.name} takes no reference picture; leave it out")
        if self.history not in (0, model.history):
            raise ValueError(f"history must be {' or '.join(str(n) for n in sorted({0, model.history}))} for {model.name}, got {history}")

    @torch.no_grad()  # not inference mode, whose tensors nobody may write to
    def step(self, frame: Frame | torch.Tensor, memory: Recent | None = None) -> tuple[torch.Tensor, Recent]:
        """One frame enhanced: float32 `[H, W, 3]` in 0..1, and the memory to pass with the next frame.

        frame   rgb `[H, W, 3]` display-referred, of any size: sides are padded to what the model takes and cut back, larger frames are
                worked on in overlapping parts
        memory  of the frame before; None at the start of a clip. Dropped where the size changed and after a cut, where the pictures do not
                look alike; until there are as many results as the model takes, each frame is worked on by itself, as the release does.

        Raises ValueError for values that are not finite, given or made.
        """
        rgb = checked(frame).rgb.to(self.device, torch.float32).clamp(0, 1)
        last = () if memory is None or not _follows(rgb, memory.given) else memory.frames
        clip = (rgb, *last) if self.history and len(last) == self.history else (rgb,)
        if self.reference is not None:
            clip = (rgb, _resized(self.reference, rgb.shape[:2]))
        out = in_parts(self.model, torch.stack(clip).permute(0, 3, 1, 2)[None], torch.bfloat16 if self.bfloat16 else torch.float32)
        if not out.isfinite().all():
            raise ValueError(f"{self.about.get('file', self.model.name)} makes values that are not finite of a frame; fetch it again")
        better = out[0].permute(1, 2, 0).clamp(0, 1).contiguous()
        return better, Recent(rgb, (better.clone(), *last)[: max(self.history, 1)])  # what is handed out may be drawn on


def in_parts(model: Model, clip: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """The model's picture `[1, 3, H, W]` of frames `[1, V, 3, H, W]` of any size, float32."""
    height, width = clip.shape[-2:]
    rows, columns = model.window or (min(_up(n, model.multiple), LARGEST) for n in (height, width))
    bottom, right = max(rows, _up(height, model.multiple)) - height, max(columns, _up(width, model.multiple)) - width
    padded = F.pad(clip.flatten(0, 1), (0, right, 0, bottom), mode="replicate").unflatten(0, clip.shape[:2])
    out = padded.new_zeros(1, 3, *padded.shape[-2:])
    weight = torch.zeros_like(out[:, :1])
    for y in _starts(padded.shape[-2], rows, model.multiple):
        for x in _starts(padded.shape[-1], columns, model.multiple):
            window = (..., slice(y, y + rows), slice(x, x + columns))
            share = torch.minimum(_ramp(rows)[:, None], _ramp(columns)).to(out)
            out[window] += share * model(padded[window].to(dtype)).float()
            weight[window] += share
    return (out / weight)[..., :height, :width]


def _starts(length: int, window: int, multiple: int) -> Iterator[int]:
    """Where windows begin that cover `length`, spread evenly, at multiples."""
    count = 1 if length <= window else -(-(length - OVERLAP) // (window - OVERLAP))
    for i in range(count):
        yield round((length - window) * i / max(count - 1, 1) / multiple) * multiple


def _ramp(length: int) -> torch.Tensor:
    """How much each pixel of a window counts: little at its ends, fully from OVERLAP on."""
    near = torch.arange(1, length + 1)
    return torch.minimum(near, near.flip(0)).clamp(max=OVERLAP) / OVERLAP


def _up(length: int, multiple: int) -> int:
    return -(-length // multiple) * multiple


def _follows(rgb: torch.Tensor, before: torch.Tensor) -> bool:
    """Whether a frame `[H, W, 3]` can be of the same clip as the one before it."""
    if rgb.shape != before.shape:
        return False
    return bool(alike(*(frame.permute(2, 0, 1)[None] for frame in (rgb, before))))


def _resized(rgb: torch.Tensor, size: torch.Size | tuple[int, ...]) -> torch.Tensor:
    """`[h, w, 3]` to `[H, W, 3]`."""
    return F.interpolate(rgb.permute(2, 0, 1)[None], tuple(size), mode="bilinear", antialias=True)[0].permute(1, 2, 0)
