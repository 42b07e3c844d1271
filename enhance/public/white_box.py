"""Ke et al.'s Harmonizer (ECCV 2022): an EfficientNet-B0 that sees foreground and background apart, and predicts six filters' arguments.

Modules are named as in the released `harmonizer.pth` (ZHKKKe/Harmonizer). Only what instances cover is changed, so a frame needs those.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn
from torch.nn import functional as F

from enhance.alike import alike, thin
from enhance.public.filters import FILTERS, harmonized
from enhance.public.layout import fill, finite
from enhance.step import checked
from render.frame_types import Frame

NAME = "Harmonizer of Ke et al."
SIDE = 256
"""Pixels of the square that frames are shrunk to for their arguments."""

KEPT = 1 - 1 / 25
"""Of the arguments so far, from one frame to the next."""

STAGES = ((1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80), (3, 5, 1, 6, 112), (4, 5, 2, 6, 192), (1, 3, 1, 6, 320))
"""Of EfficientNet-B0: blocks, kernel, stride of the first, expansion, channels."""

EPS = 1e-3
BESIDE = r".*\.num_batches_tracked"


class Same(nn.Conv2d):
    """Padded as TensorFlow's SAME: what is odd goes to the right and bottom."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        spare = self.kernel_size[0] - self.stride[0]
        before, after = spare // 2, spare - spare // 2
        return super().forward(F.pad(x, (before, after, before, after)))


class Block(nn.Module):
    """A mobile inverted bottleneck."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expand: int):
        super().__init__()
        inner, squeezed = inputs * expand, max(1, inputs // 4)
        if expand > 1:
            self._expand_conv, self._bn0 = nn.Conv2d(inputs, inner, 1, bias=False), nn.BatchNorm2d(inner, EPS)
        self._depthwise_conv = Same(inner, inner, kernel, stride, groups=inner, bias=False)
        self._bn1 = nn.BatchNorm2d(inner, EPS)
        self._se_reduce, self._se_expand = nn.Conv2d(inner, squeezed, 1), nn.Conv2d(squeezed, inner, 1)
        self._project_conv, self._bn2 = nn.Conv2d(inner, outputs, 1, bias=False), nn.BatchNorm2d(outputs, EPS)
        self.skips, self.expands = stride == 1 and inputs == outputs, expand > 1

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = F.silu(self._bn0(self._expand_conv(x))) if self.expands else x
        y = F.silu(self._bn1(self._depthwise_conv(y)))
        y = y * torch.sigmoid(self._se_expand(F.silu(self._se_reduce(y.mean((2, 3), keepdim=True)))))
        y = self._bn2(self._project_conv(y))
        return x + y if self.skips else y


class Backbone(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self._conv_fg, self._bn_fg = Same(4, 16, 3, 2, bias=False), nn.BatchNorm2d(16, EPS)
        self._conv_bg, self._bn_bg = Same(4, 16, 3, 2, bias=False), nn.BatchNorm2d(16, EPS)
        blocks, width = [], 32
        for count, kernel, stride, expand, outputs in STAGES:
            for i in range(count):
                blocks.append(Block(width, outputs, kernel, 1 if i else stride, expand))
                width = outputs
        self._blocks = nn.Sequential(*blocks)
        self._conv_head, self._bn1 = nn.Conv2d(width, 1280, 1, bias=False), nn.BatchNorm2d(1280, EPS)

    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        front = F.silu(self._bn_fg(self._conv_fg(torch.cat([image, mask], 1))))
        back = F.silu(self._bn_bg(self._conv_bg(torch.cat([image, 1 - mask], 1))))
        return F.silu(self._bn1(self._conv_head(self._blocks(torch.cat([front, back], 1))))).mean((2, 3))


class Regressor(nn.Module):
    """Arguments one after the other, each head seeing what the one before made of the features."""

    def __init__(self) -> None:
        super().__init__()
        self.f, self.g = nn.Linear(1280, 160), nn.Linear(1280, 160)
        self.headers = nn.ModuleList(nn.ModuleList([nn.Linear(320, 160), nn.Linear(160, 1)]) for _ in FILTERS)

    def forward(self, features: torch.Tensor) -> list[torch.Tensor]:
        kept, passed, found = self.f(features), self.g(features), []
        for head in self.headers:
            assert isinstance(head, nn.ModuleList)
            passed = head[0](torch.cat([kept, passed], 1))
            found.append(head[1](passed)[:, 0])
        return found


class WhiteBox(nn.Module):
    name = NAME

    def __init__(self) -> None:
        super().__init__()
        self.backbone, self.regressor = Backbone(), Regressor()

    @classmethod
    def read(cls, path: Path, state: Mapping[str, object]) -> WhiteBox:
        """From the released tensors. ValueError as `strict`."""
        net = cls()
        fill(path, NAME, net, state, beside=BESIDE)
        finite(path, net)
        return net.eval().requires_grad_(False)

    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> list[torch.Tensor]:
        """Images `[B, 3, H, W]` in 0..1 and masks `[B, 1, H, W]` to six arguments `[B]`."""
        image, mask = (F.interpolate(x, (SIDE, SIDE), mode="bilinear", align_corners=False) for x in (image, mask))
        return self.regressor(self.backbone(image, mask))


@dataclass(frozen=True)
class Arguments:
    """The filters' arguments `[6]`, averaged over the frames so far, and what the last of these looked like, in small."""

    mean: torch.Tensor
    look: torch.Tensor


class WhiteBoxEnhancer:
    """`better, memory = enhancer.step(frame, memory)`, as `Enhancer`: a Frame's instances are harmonized, all else stays as it is."""

    reads: tuple[str, ...] = ("instance",)

    def __init__(self, model: WhiteBox, about: dict | None = None, device: str | torch.device = "cpu"):
        self.device = torch.device(device)
        self.model, self.about = model.to(self.device), about or {}

    @torch.no_grad()  # not inference mode, whose tensors nobody may write to
    def step(self, frame: Frame | torch.Tensor, memory: Arguments | None = None) -> tuple[torch.Tensor, Arguments | None]:
        """One frame of any size: float32 `[H, W, 3]` in 0..1; as it went in where it has no instance, or none is seen. After a cut the
        average begins anew. Raises ValueError for values that are not finite."""
        given = checked(frame)
        rgb = given.rgb.to(self.device, torch.float32).clamp(0, 1)
        if given.instance is None or not (given.instance > 0).any():
            return rgb, memory
        image, mask = rgb.permute(2, 0, 1)[None], (given.instance > 0).to(rgb)[None, None]
        now, look = torch.cat(self.model(image, mask)), thin(image)
        if memory is not None and memory.look.shape == look.shape and alike(look, memory.look)[0]:
            now = KEPT * memory.mean + (1 - KEPT) * now
        return harmonized(image, mask, now[:, None].unbind())[0].permute(1, 2, 0).contiguous(), Arguments(now, look)
