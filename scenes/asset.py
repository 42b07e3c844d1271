"""An asset of the databank, and an actor: an asset that goes somewhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from scenes.camera import Camera
from scenes.checks import check_tensor
from scenes.deformation import Deformation
from scenes.gaussians import Gaussians, SplatModel
from scenes.trajectory import Trajectory


@dataclass(frozen=True)
class AssetPhoto:
    """A photo of an object, cut out: a camera in the object's frame, at the moment of the photo, and `read()`, which gives its pixels,
    uint8 `[H, W, 4]` of the camera's size: display-referred colour, and 255 where it shows the object, else 0."""

    camera: Camera
    read: Callable[[], np.ndarray]


@dataclass(frozen=True)
class Asset:
    """Splats of one object: origin at the base centre of its box, x forward, z up; `size` `[3]` length, width, height in metres. photos:
    those that it was cut out of, which show what its splats blur."""

    gaussians: Gaussians
    size: torch.Tensor
    label: str
    model: SplatModel = field(default_factory=SplatModel)
    meta: dict = field(default_factory=dict)
    photos: tuple[AssetPhoto, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "size", torch.as_tensor(self.size, dtype=torch.float64))
        check_tensor("size", self.size, (3,), torch.float64)
        if not (self.size > 0).all():
            raise ValueError(f"size must be positive metres, got {self.size.tolist()}")


@dataclass(frozen=True)
class Actor:
    """An asset on a trajectory of its own frame; `track` names it in the log and in the scene. deformation: how it bends on the way, in
    that frame; rigid where None."""

    asset: Asset
    trajectory: Trajectory
    track: str
    deformation: Deformation | None = None

    @property
    def recorded(self) -> bool:
        """Whether its splats were reconstructed from this drive, and not taken from a databank (which gives them an id)."""
        return not self.asset.meta.get("inserted") and "id" not in self.asset.meta

    @property
    def anew(self) -> bool:
        """Whether it was inserted or edited, so that no photo shows it in its place, light and shadow."""
        return bool(self.asset.meta.get("inserted") or self.asset.meta.get("edited"))
