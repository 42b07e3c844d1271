"""The call that every enhancer has, and what a frame must be to be given to one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch

from render.frame_types import Frame
from scenes.camera import Camera
from scenes.checks import check_floats, check_tensor
from scenes.lenses import Pinhole

BYTES = 2.0
"""Mean of a picture from which it cannot be 0..1, however bright: bytes as floats, or linear light without an exposure."""


class Steps(Protocol):
    """An enhancer: frames of one clip in order, `better, memory = enhancer.step(frame, memory)`, memory None at its start.

    about  what is known of the weights, json-like
    reads  what it uses of a rendered frame beside rgb; photos of the drive, too, where "reference" is among it
    """

    about: dict
    reads: tuple[str, ...]
    device: torch.device

    def step(self, frame: Frame | torch.Tensor, memory: Any = None) -> tuple[torch.Tensor, Any]: ...


@dataclass(frozen=True)
class Given:
    """Of a frame: rgb `[H, W, 3]`, flow `[H, W, 2]`, objects' ids and need `[H, W]`, and reference `[H, W, 3]` with trust `[H, W]`; None
    where it has none."""

    rgb: torch.Tensor
    flow: torch.Tensor | None = None
    instance: torch.Tensor | None = None
    need: torch.Tensor | None = None
    reference: tuple[torch.Tensor, torch.Tensor] | None = None


def checked(frame: Frame | torch.Tensor) -> Given:
    """What a frame gives, checked."""
    if isinstance(frame, Frame):
        if frame.rgb is None:
            raise ValueError("the frame has no rgb; render it with outputs=('rgb', ...)")
        rgb, flow, instance, need = frame.rgb, frame.flow_prev, frame.instance, frame.need
        reference = None if frame.reference is None or frame.trust is None else (frame.reference, frame.trust)
    else:
        rgb, flow, instance, need, reference = frame, None, None, None, None
    check_rgb("rgb", rgb, rendered=isinstance(frame, Frame))
    height, width = rgb.shape[:2]
    if flow is not None:
        check_tensor("flow_prev", flow, (height, width, 2))
    if instance is not None:
        check_tensor("instance", instance, (height, width))
        instance = _ids(instance)
    if need is not None:
        check_tensor("need", need, (height, width))
        need = torch.nan_to_num(need, nan=1.0)  # where nobody knows there may be need
    if reference is not None:
        check_tensor("reference", reference[0], (height, width, 3))
        check_tensor("trust", reference[1], (height, width))
        check_rgb("reference", reference[0])  # stored ones are bytes, and would be laid in as white
        if reference[1].dtype != torch.bool:
            check_floats("trust", reference[1])
            _check_finite("trust", reference[1])
        reference = reference[0], reference[1].clamp(0, 1)
    return Given(rgb, flow, instance, need, reference)


def check_rgb(name: str, rgb: torch.Tensor, rendered: bool = False) -> None:
    """ValueError unless `[H, W, 3]` holds pixels, finite floats in 0..1, or about so: what is rendered may be as bright as bytes are."""
    check_tensor(name, rgb, ("H", "W", 3))
    height, width = rgb.shape[:2]
    if height == 0 or width == 0:
        raise ValueError(f"{name} must hold pixels, got {width}x{height}")
    check_floats(name, rgb)
    _check_finite(name, rgb)
    if not rendered and (mean := float(rgb.mean(dtype=torch.float32))) > BYTES:
        raise ValueError(f"{name} must be floats in 0..1, but its mean is {mean:.4g}; divide bytes by 255")


def _ids(instance: torch.Tensor) -> torch.Tensor:
    """Objects' ids as torch compares them, which it hardly does as unsigned 16 bits; ValueError unless they are whole numbers: of floats
    some may be none, or a mask's soft edge."""
    if instance.is_floating_point() or instance.is_complex():
        raise ValueError(f"instance must hold ids, whole numbers, got {instance.dtype}; give instance.round().int(), 0 where no object is")
    return instance.long() if instance.dtype in (torch.uint16, torch.uint32, torch.uint64) else instance


def frame_of(rgb: torch.Tensor, instance: torch.Tensor | None) -> Frame:
    """A frame of no camera, of rgb `[H, W, 3]` and of what is known of its objects `[H, W]`."""
    height, width = rgb.shape[:2]
    nowhere = Camera(Pinhole(1.0, 1.0, width / 2, height / 2), width, height, torch.eye(4, dtype=torch.float64))
    return Frame(nowhere, rgb=rgb, instance=instance)


def _check_finite(name: str, image: torch.Tensor) -> None:
    if torch.isfinite(image.sum()) or torch.isfinite(image).all():  # a sum is read once, and finite unless some value is not
        return
    row, column = (~torch.isfinite(image)).nonzero()[0, :2].tolist()
    raise ValueError(f"{name} holds a value that is not finite at row {row}, column {column}; enhance finite frames only")
