"""The recorded pictures that renders are compared with, shrunk as a fit goes from coarse to fine."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from recon.views.frames import SMALLEST
from recon.views.view import View
from render.kept import kept_beside
from scenes.camera import Camera


class Targets:
    """Views' pictures, shrunk by a factor; those of the present factor are kept."""

    def __init__(self) -> None:
        self._kept: dict[tuple[int, int, int], torch.Tensor] = {}

    def size(self, view: View, shrink: int) -> tuple[int, int]:
        """Width and height of a view's shrunk picture."""
        height, width = view.image.shape[:2]
        return max(SMALLEST, width // shrink), max(SMALLEST, height // shrink)

    def picture(self, view: View, shrink: int) -> torch.Tensor:
        """A view's picture `[h, w, 3]` in 0..1, area-averaged."""
        if shrink == 1:
            return view.image.float().mul_(1 / 255)
        key = (shrink, view.camera, view.index)
        if key not in self._kept:
            width, height = self.size(view, shrink)
            small = F.interpolate(view.image.permute(2, 0, 1)[None].float(), (height, width), mode="area")[0].permute(1, 2, 0)
            self._kept = {k: v for k, v in self._kept.items() if k[0] == shrink}
            self._kept[key] = small.contiguous()
        return self._kept[key] / 255


def ego_at(view: View, camera: Camera) -> torch.Tensor:
    """What of a picture of the view, of the camera's size, shows the recording car: bool `[H, W, 1]`; shared, not to be written to."""
    assert view.ego is not None
    return _shrunk(view.ego, camera.height, camera.width)


@kept_beside
def _shrunk(mask: torch.Tensor, height: int, width: int) -> torch.Tensor:
    return F.adaptive_max_pool2d(mask[None].float(), (height, width))[0, :, :, None] > 0


def scale_of(view: View, camera: Camera) -> float:
    """How large a camera's picture of a view is to the whole one."""
    return camera.width / view.image.shape[1]
