"""What a render gives back, and how exactly it is computed."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch

from render.budget import split
from render.outputs import OUTPUTS as OUTPUTS
from render.outputs import check_outputs as check_outputs
from scenes.camera import Camera


@dataclass(frozen=True)
class RenderConfig:
    """How far the picture may be from the exact sum over all splats.

    alpha_cutoff: contributions below it are skipped; alpha_max: no splat is more opaque;
    termination: a pixel is finished when this much light still passes. max_error: the largest error of a pixel's colour; it sets all
    these, the cutoff lower the more splats there are, and order "pixel" (`render/budget.py`).
    order: "tile", by the depth of the splats' centres, unless told; or "pixel", by where each pixel's own ray meets them: nothing pops.
    most_entries: splat-tile entries that are drawn at once; it bounds memory and changes no pixel (`render/chunks.py`).
    """

    alpha_cutoff: float = 1 / 255
    alpha_max: float = 0.999
    termination: float = 1e-4
    max_error: float | None = None
    order: str | None = None
    most_entries: int = 1 << 25

    def __post_init__(self):
        if self.order not in (None, "tile", "pixel"):
            raise ValueError(f'order must be "tile" or "pixel", got {self.order!r}')
        if self.max_error is not None:
            if self.order == "tile":
                raise ValueError('max_error is kept in order "pixel" only; leave order="tile" out, or max_error')
            for name, limit in split(self.max_error).items():
                object.__setattr__(self, name, limit)
        elif self.order is None:
            object.__setattr__(self, "order", "tile")
        for name in ("alpha_cutoff", "termination"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 0 and below 1, got {getattr(self, name)}")
        if not 1 <= self.most_entries < 2**31:
            raise ValueError(f"most_entries must be at least 1 and below 2^31, got {self.most_entries}")
        if not 0 < self.alpha_max <= 1:
            raise ValueError(f"alpha_max must be above 0 and at most 1, got {self.alpha_max}")


@dataclass(frozen=True)
class Frame:
    """The view of one camera. What was not requested is None and was not computed.

    rgb `[H, W, 3]` display-referred, premultiplied over black where no background was given, not clamped above 1;
    alpha `[H, W]`; depth `[H, W]` in metres, inf where alpha is 0: z, and for fisheye and equirectangular lenses the distance, at which the
    pixel's ray meets the splats, the mean by their weights; it meets each where that is densest along it, to first order with response
    "conic" (Zhang et al. 2024, "RaDe-GS"), and there no nearer than half as far as its centre; median_depth `[H, W]` that of the splat
    behind which less than half of the light passes, inf where alpha is below 0.5; normal `[H, W, 3]` unit vectors in the camera, towards
    it, 0 where alpha is 0;
    features `[H, W, C]` summed as colours are; flow_prev, flow_next `[H, W, 2]` pixels to the same point in the other frame, and
    visible_prev, visible_next `[H, W]` bool, whether that frame shows it; instance `[H, W]` int32, the id whose splats weigh most together
    of what is drawn there (of two always the heavier, of more surely one that is more than half), -1 where alpha is below 0.5;
    instance_alpha `[H, W, P]` what each placed instance adds to alpha, of a scene what each id does; need `[H, W]` 0 to 1, how badly the
    place is supported by photos (`render/need.py`).

    No outputs, but added to frames that are to be enhanced (`render/references.py`): reference `[H, W, 3]`, what the drive's photos say the
    view looks like, and trust `[H, W]` 0 to 1, how far to go from rgb to it.
    """

    camera: Camera
    rgb: torch.Tensor | None = None
    alpha: torch.Tensor | None = None
    depth: torch.Tensor | None = None
    median_depth: torch.Tensor | None = None
    normal: torch.Tensor | None = None
    features: torch.Tensor | None = None
    flow_prev: torch.Tensor | None = None
    flow_next: torch.Tensor | None = None
    visible_prev: torch.Tensor | None = None
    visible_next: torch.Tensor | None = None
    instance: torch.Tensor | None = None
    instance_alpha: torch.Tensor | None = None
    need: torch.Tensor | None = None
    reference: torch.Tensor | None = None
    trust: torch.Tensor | None = None

    def to(self, device: torch.device | str) -> Frame:
        """The same frame on a device."""
        tensors = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "camera"}
        return replace(self, **{name: t.to(device) for name, t in tensors.items() if t is not None})

    def outputs(self) -> dict[str, torch.Tensor]:
        """The outputs that were computed, by name."""
        have = {name: getattr(self, name) for name in OUTPUTS}
        return {name: value for name, value in have.items() if value is not None}
