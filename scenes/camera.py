"""A camera at a time and place, and a camera of the rig."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from numbers import Integral

import torch

from scenes.checks import check_tensor
from scenes.lenses import Lens
from scenes.poses import as_pose
from scenes.trajectory import Trajectory, between

SHUTTERS = ("global", "rows", "columns")

DARKEST = 0.05
"""Gain below which no camera's exposure is taken to fall: a fitted affine one may say anything of colours that it never met."""


def neutral_exposure() -> torch.Tensor:
    """The affine colour `[3, 4]` that changes nothing."""
    return torch.eye(3, 4, dtype=torch.float32)


def check_shutter(shutter: str, readout_us: int) -> None:
    if shutter not in SHUTTERS:
        raise ValueError(f"shutter must be one of {', '.join(SHUTTERS)}, got {shutter!r}")
    if readout_us and shutter == "global":
        raise ValueError(f"readout_us must be 0 with a global shutter, got {readout_us}")


def check_size(width: int, height: int) -> None:
    if not (isinstance(width, Integral) and isinstance(height, Integral) and width >= 1 and height >= 1):
        raise ValueError(f"a camera must have whole numbers of at least 1x1 pixels, got {width}x{height}")


@dataclass(frozen=True)
class Camera:
    """One exposure: lens, size in pixels, `world_from_cam` float64 `[4, 4]` (OpenCV axes), and time.

    With an end pose and shutter "rows" or "columns" the pose moves while the image is read out: from `world_from_cam` at the image's
    top (left) edge, at `time_us`, to `world_from_cam_end` at its bottom (right) edge, `readout_us` later, or earlier if that is negative.
    `exposure` is an affine colour `[3, 4]` that `render_frame` applies last but one: rgb' = E[:, :3] rgb + E[:, 3]; and `flat_field` the
    gains `[h, w, 3]` that it applies last, of a grid of cells over the picture, linear between their middles; None: 1 everywhere.
    trained_focal: pixels a radian of the pictures that what it shows was fitted to; None where the rig is to tell (`Scene.model_for`).
    """

    lens: Lens
    width: int
    height: int
    world_from_cam: torch.Tensor
    world_from_cam_end: torch.Tensor | None = None
    time_us: int = 0
    shutter: str = "global"
    exposure: torch.Tensor | None = None
    readout_us: int = 0
    flat_field: torch.Tensor | None = None
    trained_focal: float | None = None

    def __post_init__(self):
        check_size(self.width, self.height)
        check_shutter(self.shutter, self.readout_us)
        for name in ("world_from_cam", "world_from_cam_end"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_pose(getattr(self, name)))
                check_tensor(name, getattr(self, name), (4, 4), torch.float64)
        if self.exposure is not None:
            check_tensor("exposure", self.exposure, (3, 4))
        if self.flat_field is not None:
            check_tensor("flat_field", self.flat_field, ("h", "w", 3))

    def resized(self, width: int, height: int) -> Camera:
        """The same view on an image of another size."""
        check_size(width, height)
        return replace(self, lens=self.lens.scaled(width / self.width, height / self.height), width=width, height=height)

    def pixel_centres(self) -> torch.Tensor:
        """float64 `[H, W, 2]` pixel coordinates."""
        y, x = torch.meshgrid(torch.arange(self.height, dtype=torch.float64), torch.arange(self.width, dtype=torch.float64), indexing="ij")
        return torch.stack([x, y], -1) + 0.5


def followed(frames: Iterable[tuple[torch.Tensor, torch.Tensor | None]], time_us: int) -> torch.Tensor | None:
    """The gain `[3]` at a time that cameras have in the mean, of their frames' times `[F]` and gains `[F, 3]`; None where none varies.

    Exposure follows the light, and so does what drives along: from the shade into the sun it looks in pictures as it did.
    """
    known = [None if gains is None else between(times, gains.log(), time_us) for times, gains in frames]
    varied = [log for log in known if log is not None]
    return (sum(varied[1:], varied[0]) / len(known)).exp() if varied else None


@dataclass(frozen=True)
class RigCamera:
    """A camera fixed to the body: `body_from_cam` float64 `[4, 4]`, affine exposure `[3, 4]`, and when it took its frames.

    gains float32 `[F, 3]`, of frames that were exposed one by one: how many times as much as `exposure` each was; None where all alike.
    fitted: whether splats were fitted to pictures of its size. shutter "rows" or "columns": an image is read out over `readout_us` from its
    time on, top (left) edge first; negative: that one last, at its time. flat_field, trained_focal: as of `Camera`.
    """

    lens: Lens
    width: int
    height: int
    body_from_cam: torch.Tensor
    exposure: torch.Tensor = field(default_factory=neutral_exposure)
    times_us: torch.Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.int64))
    shutter: str = "global"
    readout_us: int = 0
    gains: torch.Tensor | None = None
    fitted: bool = True
    flat_field: torch.Tensor | None = None
    trained_focal: float | None = None

    def __post_init__(self):
        check_size(self.width, self.height)
        check_shutter(self.shutter, self.readout_us)
        object.__setattr__(self, "body_from_cam", as_pose(self.body_from_cam))
        check_tensor("body_from_cam", self.body_from_cam, (4, 4), torch.float64)
        check_tensor("exposure", self.exposure, (3, 4))
        check_tensor("times_us", self.times_us, ("F",), torch.int64)
        if self.gains is not None:
            check_tensor("gains", self.gains, (max(1, len(self.times_us)), 3), torch.float32)
        if self.flat_field is not None:
            check_tensor("flat_field", self.flat_field, ("h", "w", 3), torch.float32)

    def exposure_at(self, time_us: int) -> torch.Tensor:
        """The affine exposure `[3, 4]` at a time: between frames the logarithms of their gains are linear, beyond they stay."""
        gain = self.gain_at(time_us)
        return self.exposure if gain is None else gain[:, None] * self.exposure

    def gain_at(self, time_us: int) -> torch.Tensor | None:
        """How many times as much as `exposure` it exposes at a time, `[3]`; None where all frames were exposed alike."""
        return None if self.gains is None else between(self.times_us, self.gains.log(), time_us).exp()

    def at(self, world_from_body: torch.Tensor, time_us: int) -> Camera:
        """The camera of a body that stands at a pose while the image is read out."""
        world_from_cam = world_from_body @ self.body_from_cam
        camera = Camera(self.lens, self.width, self.height, world_from_cam, time_us=int(time_us), exposure=self.exposure_at(time_us))
        return replace(camera, flat_field=self.flat_field, trained_focal=self.trained_focal)

    def along(self, ego: Trajectory, time_us: int) -> Camera:
        """The camera of a body on its way, from `time_us` on. ValueError for a time off the path."""
        camera = self.at(ego.at(time_us), time_us)
        if self.shutter == "global" or not self.readout_us:
            return camera
        end = ego.near(time_us + self.readout_us) @ self.body_from_cam
        return replace(camera, world_from_cam_end=end, shutter=self.shutter, readout_us=self.readout_us)

    def resized(self, width: int, height: int) -> RigCamera:
        """The same camera with an image of another size."""
        check_size(width, height)
        return replace(self, lens=self.lens.scaled(width / self.width, height / self.height), width=width, height=height)
