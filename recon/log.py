"""A recorded drive: what every reader makes of its files and all that reconstruction sees of them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path

import numpy as np
import torch

from scenes.camera import Camera, RigCamera
from scenes.lenses import Lens
from scenes.names import unknown
from scenes.poses import interpolate, inverse, nearest_rotation
from scenes.trajectory import Trajectory

FETCH = "fetch the file again"
"""What to do about one that does not decode."""

SWEEP_US = 200_000
"""As long as a sweep may take."""


@dataclass(frozen=True)
class Packed:
    """A picture inside a larger file: `name` for messages, `read()` gives its bytes."""

    name: str
    read: Callable[[], bytes] = field(repr=False)

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class LogCamera:
    """A camera of the log: lens and native size, and per frame its file, time (us) and pose `world_from_cam` `[F, 4, 4]` at that time.

    shutter "rows" or "columns": they are read one after the other, from top (left) to bottom (right) within `readout_us`, the middle one at
    the frame's time; the other way round where `readout_us` is negative.
    ego_mask: bool `[h, w]` at any size, where all frames show the recording car itself; None where nobody says.
    """

    name: str
    lens: Lens
    width: int
    height: int
    files: tuple[Path | Packed, ...]
    times_us: torch.Tensor
    world_from_cam: torch.Tensor
    shutter: str = "global"
    readout_us: int = 0
    ego_mask: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.files)

    def part(self, frames: slice) -> LogCamera:
        """The camera with these of its frames only."""
        return replace(self, files=self.files[frames], times_us=self.times_us[frames], world_from_cam=self.world_from_cam[frames])

    def late_us(self, across: np.ndarray, down: np.ndarray) -> np.ndarray:
        """Microseconds after a frame's time at which it is read, so many parts of its width and height from its upper left corner."""
        return ({"rows": down, "columns": across}.get(self.shutter, np.full_like(down, 0.5)) - 0.5) * self.readout_us

    def image(self, index: int, width: int | None = None, height: int | None = None) -> np.ndarray:
        """Frame `index` as uint8 sRGB `[H, W, 3]`, area-averaged to `width` x `height`. ValueError naming a file that does not decode."""
        from PIL import Image

        from scenes.pictures import opened, rgb_of

        path = self.files[index]
        with opened(BytesIO(path.read()) if isinstance(path, Packed) else path, str(path), FETCH) as stored:
            picture = rgb_of(stored)
        if picture.size != (self.width, self.height):
            raise ValueError(f"{path} is {picture.width}x{picture.height}, but camera {self.name} is {self.width}x{self.height}")
        size = (width or self.width, height or self.height)
        return np.asarray(picture if picture.size == size else picture.resize(size, Image.Resampling.BOX))

    def camera(self, index: int, width: int | None = None, height: int | None = None) -> Camera:
        """The view of frame `index` at its recorded pose, resized where a size is given."""
        native = Camera(self.lens, self.width, self.height, self.world_from_cam[index], time_us=int(self.times_us[index]))
        return native.resized(width or self.width, height or self.height)


@dataclass(frozen=True)
class LidarPoints:
    """One sweep in the world: `xyz` float64 `[N, 3]` metres, `times_us` int64 `[N]`, `sensor` int64 `[N]`."""

    xyz: np.ndarray
    times_us: np.ndarray
    sensor: np.ndarray


@dataclass(frozen=True)
class Sweep:
    """A lidar sweep, read when its points are asked for."""

    index: int
    time_us: int
    read: Callable[[], LidarPoints] = field(repr=False)


ANNOTATED = 0.05
"""Metres by which boxes are off that somebody drew, or lidar tells."""


@dataclass(frozen=True)
class Track:
    """An annotated box over time. The box frame has its origin at the base centre, x forward, z up; `size` is length, width, height.

    `name` is `veh_3`, `ped_1`, ...: numbered by nearness to the ego; `label` is the class as a slug ("car"); `sensor` `[T]` is the
    lidar that saw it, -1 where the log does not say; `sources` are the log's own identifiers of the tracks merged here; `off` are the
    metres by which its places may be wrong.
    """

    name: str
    label: str
    moving: bool
    size: np.ndarray
    times_us: np.ndarray
    world_from_box: torch.Tensor
    sensor: np.ndarray
    sources: tuple[str, ...]
    off: float = ANNOTATED

    def part(self, kept: np.ndarray) -> Track:
        """The track with these of its boxes only: indices, or bool `[T]`."""
        poses = self.world_from_box[torch.from_numpy(kept)]
        return replace(self, times_us=self.times_us[kept], world_from_box=poses, sensor=self.sensor[kept])

    def trajectory(self) -> Trajectory:
        return Trajectory(torch.from_numpy(self.times_us), self.world_from_box)


@dataclass(frozen=True)
class SparsePoints:
    """What pictures alone showed (structure from motion): `xyz` float64 `[N, 3]` in the world; `seen` by camera: each frame's points."""

    xyz: np.ndarray
    seen: dict[str, tuple[np.ndarray, ...]]


@dataclass(frozen=True)
class Log:
    """A drive: cameras by name, lidar sweeps (gaps are normal), tracks, and the body's trajectory. The world starts near its first pose.

    `front` names the cameras that a reconstruction takes where nobody names any; the first one where it is empty. `points` stand
    in for lidar where the poses come from pictures. `lidars` is where they stand in the body, `[3]` by the points' sensor number; of a
    sensor that it lacks that is not known. `meta["metric"]` is False where the world's unit is not the metre, `meta["heights"]` where the
    path has none.
    """

    name: str
    path: Path
    cameras: dict[str, LogCamera]
    sweeps: tuple[Sweep, ...]
    tracks: tuple[Track, ...]
    ego: Trajectory
    meta: dict
    front: tuple[str, ...] = ()
    points: SparsePoints | None = None
    lidars: dict[int, np.ndarray] = field(default_factory=lambda: {0: np.zeros(3)})

    def sweeps_within(self, span_us: tuple[int, int]) -> tuple[Sweep, ...]:
        """The sweeps of a span of time, and those that begin before it or end after it: `SWEEP_US` around."""
        return tuple(s for s in self.sweeps if span_us[0] - SWEEP_US <= s.time_us <= span_us[1] + SWEEP_US)

    def camera(self, name: str) -> LogCamera:
        """The camera of that name; ValueError naming the nearest where there is none."""
        if name not in self.cameras:
            raise ValueError(unknown("camera", name, str(self.path), list(self.cameras)))
        return self.cameras[name]

    def rig(self, sizes: Mapping[str, tuple[int, int]]) -> dict[str, RigCamera]:
        """The cameras named as fixed to the body, at working sizes (width, height): each extrinsic is the mean over its frames."""
        rig = {}
        for name, (width, height) in sizes.items():
            cam = self.camera(name)
            lens = cam.lens.scaled(width / cam.width, height / cam.height)
            began = cam.times_us - cam.readout_us // 2
            mount = mean_pose(self.offsets(name))
            rig[name] = RigCamera(lens, width, height, mount, times_us=began, shutter=cam.shutter, readout_us=cam.readout_us)
        return rig

    def offsets(self, name: str) -> torch.Tensor:
        """`body_from_cam` `[F, 4, 4]` of every frame: the recorded camera pose as seen from the body at that moment."""
        cam = self.camera(name)
        return inverse(self.ego.at_each(cam.times_us)) @ cam.world_from_cam


def image_size(file: Path) -> tuple[int, int]:
    """Width and height of an image file, without decoding it. ValueError naming a file that is none."""
    from scenes.pictures import opened

    with opened(file, str(file), FETCH) as picture:
        return picture.size


def is_upright(file: Path) -> bool:
    """Whether an image file is stored as it is to be seen, not turned as phones store portraits. ValueError naming a file that is none."""
    from scenes.pictures import is_turned, opened

    with opened(file, str(file), FETCH) as picture:
        return not is_turned(picture)


def leading(files: Sequence[Path], what: str = "pictures") -> tuple[Path, ...]:
    """The files that are there of those that time stamps name, where no more than the last are missing. what: they are, for messages.

    A piece of a drive, as others share it, has its first pictures and all of its time stamps; stderr says how many. FileNotFoundError
    naming a file that is missing before others, which a download broke off, or the first where there is none.
    """
    count = next((i for i, file in enumerate(files) if not file.is_file()), len(files))
    if count < len(files):
        if not count or any(file.is_file() for file in files[count:]):
            raise FileNotFoundError(f"{files[count]} is missing; the time stamps name {len(files)} frames")
        print(f"{files[0].parent} holds the first {count} of {len(files)} {what}, which are read", file=sys.stderr)
    return tuple(files[:count])


def lengthened(times_us: np.ndarray, poses: torch.Tensor) -> Trajectory:
    """A body's trajectory with one more pose at either end, at constant velocity: sensors fire up to a sweep off its stamps."""
    if len(times_us) > 1:
        before, after = interpolate(poses[0], poses[1], -1.0), interpolate(poses[-2], poses[-1], 2.0)
        times_us = np.concatenate([[2 * times_us[0] - times_us[1]], times_us, [2 * times_us[-1] - times_us[-2]]])
        poses = torch.cat([before[None], poses, after[None]])
    return Trajectory(torch.from_numpy(times_us), poses)


def mean_pose(poses: torch.Tensor) -> torch.Tensor:
    """The mean of nearby poses `[F, 4, 4]`: mean position, and the rotation nearest to the mean matrix."""
    out = torch.eye(4, dtype=torch.float64)
    out[:3, :3], out[:3, 3] = nearest_rotation(poses[:, :3, :3].mean(0)), poses[:, :3, 3].mean(0)
    return out
