"""A camera at a time and place, and a camera of the rig."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch

from scenes.checks import check_tensor
from scenes.lens import Pinhole
from scenes.poses import as_pose

SHUTTERS = ("global", "rows", "columns")


def neutral_exposure() -> torch.Tensor:
    """The affine colour `[3, 4]` that changes nothing."""
    return torch.eye(3, 4)


def check_size(width: int, height: int) -> None:
    if width < 1 or height < 1:
        raise ValueError(f"a camera must be at least 1x1 pixels, got {width}x{height}")


@dataclass(frozen=True)
class Camera:
    """One exposure: lens, size in pixels, `world_from_cam` float64 `[4, 4]` (OpenCV axes), and time.

    With an end pose and shutter "rows" or "columns" the pose moves from the first to the last row or column.
    `exposure` is an affine colour `[3, 4]` that `render_frame` applies last: rgb' = E[:, :3] rgb + E[:, 3].
    """

    lens: Pinhole
    width: int
    height: int
    world_from_cam: torch.Tensor
    world_from_cam_end: torch.Tensor | None = None
    time_us: int = 0
    shutter: str = "global"
    exposure: torch.Tensor | None = None

    def __post_init__(self):
        check_size(self.width, self.height)
        if self.shutter not in SHUTTERS:
            raise ValueError(f"shutter must be one of {', '.join(SHUTTERS)}, got {self.shutter!r}")
        for name in ("world_from_cam", "world_from_cam_end"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_pose(getattr(self, name)))
                check_tensor(name, getattr(self, name), (4, 4), torch.float64)
        if self.exposure is not None:
            check_tensor("exposure", self.exposure, (3, 4))

    def resized(self, width: int, height: int) -> Camera:
        """The same view on an image of another size."""
        return replace(self, lens=self.lens.scaled(width / self.width, height / self.height), width=width, height=height)

    def pixel_centres(self) -> torch.Tensor:
        """float64 `[H, W, 2]` pixel coordinates."""
        y, x = torch.meshgrid(torch.arange(self.height, dtype=torch.float64), torch.arange(self.width, dtype=torch.float64), indexing="ij")
        return torch.stack([x, y], -1) + 0.5


@dataclass(frozen=True)
class RigCamera:
    """A camera fixed to the body: `body_from_cam` float64 `[4, 4]`, affine exposure `[3, 4]`, and when it took its frames."""

    lens: Pinhole
    width: int
    height: int
    body_from_cam: torch.Tensor
    exposure: torch.Tensor = field(default_factory=neutral_exposure)
    times_us: torch.Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.int64))

    def __post_init__(self):
        check_size(self.width, self.height)
        object.__setattr__(self, "body_from_cam", as_pose(self.body_from_cam))
        check_tensor("body_from_cam", self.body_from_cam, (4, 4), torch.float64)
        check_tensor("exposure", self.exposure, (3, 4))
        check_tensor("times_us", self.times_us, ("F",), torch.int64)

    def at(self, world_from_body: torch.Tensor, time_us: int) -> Camera:
        """The camera of a body at a pose."""
        world_from_cam = world_from_body @ self.body_from_cam
        return Camera(self.lens, self.width, self.height, world_from_cam, time_us=int(time_us), exposure=self.exposure)

    def resized(self, width: int, height: int) -> RigCamera:
        """The same camera with an image of another size."""
        return replace(self, lens=self.lens.scaled(width / self.width, height / self.height), width=width, height=height)
