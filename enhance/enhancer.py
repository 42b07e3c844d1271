"""The enhancer as it is used: one call a frame, state passed in and out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch.nn import functional as F

from enhance.net import MULTIPLE, Net
from enhance.past import Past
from enhance.precision import autocast, channels_last
from enhance.weights_file import BUILTIN, load_net
from render.frame_types import Frame
from scenes.checks import check_tensor


@dataclass(frozen=True)
class Memory:
    """What is remembered between the frames of a clip: their past, the frames' height and width in pixels, and whether they had flow."""

    past: Past
    size: tuple[int, int]
    flow: bool


class Enhancer:
    """A trained network behind the call that every enhancer has: `better, memory = enhancer.step(frame, memory)`."""

    def __init__(self, net: Net, about: dict | None = None, device: str | torch.device = "cpu"):
        self.device = torch.device(device)
        self.net = channels_last(net.eval().requires_grad_(False).to(self.device))
        self.about = about or {}

    @classmethod
    def load(cls, weights: str | Path = "builtin", device: str | torch.device = "cpu") -> Enhancer:
        """The shipped weights ("builtin") or those of a safetensors file. FileNotFoundError, ValueError as `load_net`."""
        net, about = load_net(BUILTIN if weights == "builtin" else weights)
        return cls(net, about, device)

    @torch.inference_mode()
    def step(self, frame: Frame | torch.Tensor, memory: Memory | None = None) -> tuple[torch.Tensor, Memory]:
        """One frame enhanced: float32 `[H, W, 3]` in 0..1, and the memory to pass with the next frame.

        frame   rgb `[H, W, 3]` display-referred, of any size, or a rendered Frame: its flow_prev then moves the memory exactly
                and its instance says where objects were put, both optional. Without flow the memory stays in place.
        memory  of the frame before; None at the start of a clip. It is dropped where the size changed, and where a frame lacks
                the flow that the frames before it had.

        Pixels whose gate is 0 come back exactly as they went in (clamped to 0..1). Raises ValueError for values that are not finite.
        """
        rgb, flow, mask = _inputs(frame)
        height, width = rgb.shape[:2]
        if memory is not None and (memory.size != (height, width) or (memory.flow and flow is None)):
            memory = None
        rgb = rgb.to(self.device, torch.float32).clamp(0, 1)
        padded = _pad(rgb.permute(2, 0, 1)[None], mode="replicate")
        mask = None if mask is None else _pad(mask.to(self.device, torch.float32)[None, None], value=0)
        past = None if memory is None else memory.past
        if past is not None and flow is not None:
            past = past.moved(_pad(flow.to(self.device, torch.float32).permute(2, 0, 1)[None], value=torch.nan))
        with autocast(self.device):
            out = self.net(padded, mask, past)
        better = out.rgb[0, :, :height, :width].permute(1, 2, 0).clamp(0, 1).contiguous()
        return better, Memory(out.past, (height, width), flow is not None)


def _inputs(frame: Frame | torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
    """Colour `[H, W, 3]`, flow `[H, W, 2]` and object mask `[H, W]` of a frame; the latter two None where it has none."""
    if isinstance(frame, Frame):
        if frame.rgb is None:
            raise ValueError("the frame has no rgb; render it with outputs=('rgb', ...)")
        rgb, flow, instance = frame.rgb, frame.flow_prev, frame.instance
    else:
        rgb, flow, instance = frame, None, None
    check_tensor("rgb", rgb, ("H", "W", 3))
    height, width = rgb.shape[:2]
    if height == 0 or width == 0:
        raise ValueError(f"rgb must hold pixels, got {width}x{height}")
    if not rgb.is_floating_point():
        raise ValueError(f"rgb must be floats in 0..1, got {rgb.dtype}; divide bytes by 255")
    if not torch.isfinite(rgb).all():
        bad = (~torch.isfinite(rgb)).any(-1).nonzero()[0].tolist()
        raise ValueError(f"rgb holds a value that is not finite at row {bad[0]}, column {bad[1]}; enhance finite frames only")
    if flow is not None:
        check_tensor("flow_prev", flow, (height, width, 2))
    if instance is not None:
        check_tensor("instance", instance, (height, width))
    return rgb, flow, None if instance is None else instance > 0


def _pad(image: torch.Tensor, **how) -> torch.Tensor:
    """`[1, C, H, W]` grown at the right and bottom to sides that are multiples of 16."""
    height, width = image.shape[-2:]
    return F.pad(image, (0, -width % MULTIPLE, 0, -height % MULTIPLE), **how)
