"""How much of the light a camera shows over its picture: less towards its corners, more where its lens glares."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from render.kept import kept_beside
from render.launch import upload


def in_flat_field(rgb: torch.Tensor, flat_field: torch.Tensor | None) -> torch.Tensor:
    """A picture `[H, W, 3]` as a camera of this flat field `[h, w, 3]` shows it; None shows all of it alike."""
    return rgb if flat_field is None else rgb * _over_picture(flat_field, *rgb.shape[:2], rgb.device)


def evened(rgb: torch.Tensor, flat_field: torch.Tensor | None) -> torch.Tensor:
    """A camera's picture `[H, W, 3]` as it would be if it showed all of it alike."""
    return rgb if flat_field is None else rgb / _over_picture(flat_field, *rgb.shape[:2], rgb.device)


@kept_beside
def _over_picture(flat_field: torch.Tensor, height: int, width: int, device: torch.device) -> torch.Tensor:
    """float32 `[height, width, 3]` on a device, linear between the middles of its cells; shared, not to be written to."""
    planes = upload(flat_field.detach(), device).permute(2, 0, 1)[None]
    return F.interpolate(planes, (height, width), mode="bilinear")[0].permute(1, 2, 0).contiguous()
