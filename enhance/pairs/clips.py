"""A recorded clip as pairs are made of it: its photos, the scene's cameras at their moments, and exact geometry."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import torch

from enhance.pairs.shards import to_bytes
from recon.album import at_once
from recon.log import Log, LogCamera
from recon.views.egomask import at_size
from render import render_frame
from render.frame_types import Frame
from render.video import from_bytes
from render.warp import visible
from scenes.scene import Scene

SMALLEST = 0.004  # an instance must cover this share of the frame to be altered
NARROWEST = 32  # pixels: training cuts no smaller crops
NOWHERE = 255  # stored instance where nothing stands, or one beyond what a byte numbers
CLOCKS_DIFFER = 20_000  # microseconds at most between a log's and a scene's time of one picture: far less than from picture to picture


@dataclass(frozen=True)
class PairConfig:
    """Sizes of the clips."""

    width: int = 640
    """Width of the stored frames in pixels; the height follows from the camera."""
    frames: int = 6
    """Consecutive frames of a clip."""
    every: int = 6
    """Frames from one clip's start to the next's."""

    def __post_init__(self):
        if self.width < NARROWEST:
            raise ValueError(f"pairs must be at least {NARROWEST} pixels wide, got {self.width}; 640 is usual")
        if self.frames < 1 or self.every < 1:
            raise ValueError(f"frames and every must be at least 1, got {self.frames} and {self.every}")


def scene_time(scene: Scene, camera: str, time_us: int) -> int:
    """When a camera took the picture that its log has at a time, by the scene's clock, which reconstruction corrects by milliseconds."""
    known = scene.frame_times(camera)
    nearest = int(known[(known - time_us).abs().argmin()])
    return nearest if abs(nearest - time_us) <= CLOCKS_DIFFER else time_us


def of_scene(log: Log, scene: Scene) -> Log:
    """A recording with no other pictures of a scene's cameras than it was reconstructed from: it may be a part of the drive, and cameras
    may have begun before its first one did."""

    def known(camera: LogCamera) -> LogCamera:
        times = scene.rig_camera(camera.name).times_us if camera.name in scene.rig else camera.times_us
        apart = (camera.times_us[:, None] - times).abs()
        step = int(camera.times_us.diff().median()) if len(camera) > 1 else 2 * CLOCKS_DIFFER
        kept = (apart.amin(1) <= min(CLOCKS_DIFFER, step // 2)).nonzero()[:, 0].tolist() if len(times) else []
        # where none is kept the scene does not say, or is another drive's
        return camera.part(slice(kept[0], kept[-1] + 1)) if kept else camera

    return replace(log, cameras={name: known(camera) for name, camera in log.cameras.items()})


def clip_label(camera: str, start: int) -> str:
    """The name of a camera's clip that starts with a frame."""
    return f"{camera}_{start:04d}"


class Clip:
    """Consecutive photos of one camera, uint8 `[T, H, W, 3]`, and the finished scene's cameras there. Scenes are rendered on `device`;
    photos, scenes and what comes of them are on the host. meta: further facts to keep with it."""

    def __init__(
        self, scene: Scene, camera: LogCamera, start: int, config: PairConfig, seed: int, meta: dict, device: torch.device | str = "cpu"
    ):
        self.scene, self.recorded, self.start, self.device = scene, camera, start, device
        height = round(config.width * camera.height / camera.width)
        self.indices = range(start, min(start + config.frames, len(camera)))
        # The scene's own camera, not the recording's: reconstruction corrects poses, and only its poses match its splats.
        times = [scene_time(scene, camera.name, int(camera.times_us[i])) for i in self.indices]
        self.cameras = [scene.camera(camera.name, t).resized(config.width, height) for t in times]
        pictures = [from_bytes(camera.image(i, config.width, height)) for i in self.indices]
        self.photos = torch.stack([to_bytes(self.at_once(picture, t)) for t, picture in enumerate(pictures)])
        if camera.ego_mask is not None and camera.ego_mask.any():
            self._leave_out(at_size(camera.ego_mask, height, config.width))
        # Seeded by name: a clip is the same whichever others are made beside it.
        digest = hashlib.sha256(f"{seed} {camera.name} {start}".encode()).digest()
        self.seed = int.from_bytes(digest[:6], "little")
        times = [c.time_us for c in self.cameras]
        self.meta = {"camera": camera.name, "start": start, "times_us": times, "seed": seed} | meta
        self._geometry: dict[str, torch.Tensor] | None = None

    def at_once(self, picture: torch.Tensor, t: int) -> torch.Tensor:
        """A picture `[H, W, 3]` as the recording's camera took frame `t`, as if its rows had been read at once, as the scene's cameras do:
        else nothing that moves in it would lie where renders have it."""
        return at_once(self.scene, self.cameras[t], self.recorded, picture)

    def _leave_out(self, ego: torch.Tensor) -> None:
        """What the scene shows where the photos show the recording car itself, bool `[H, W]`."""
        for photo, frame in zip(self.photos, self.render(self.scene, "rgb"), strict=True):
            assert frame.rgb is not None
            photo[ego] = to_bytes(frame.rgb[ego])

    @property
    def name(self) -> str:
        return self.meta["camera"]

    @property
    def label(self) -> str:
        """By which a clip is known among those of its recording."""
        return clip_label(self.name, self.start)

    def photo(self, t: int) -> torch.Tensor:
        """Photo `t` as float32 `[H, W, 3]` in 0..1."""
        return self.photos[t].float() / 255

    def render(self, scene: Scene, *outputs: str) -> list[Frame]:
        """What a scene shows to the clip's cameras, on the host."""
        return [frame.to("cpu") for frame in self.draw(scene.to(self.device), *outputs)]

    def draw(self, scene: Scene, *outputs: str, shadows: bool = True) -> list[Frame]:
        """The same where the scene is."""
        with torch.no_grad():
            return [render_frame(scene, camera, outputs, shadows=shadows) for camera in self.cameras]

    def geometry(self, scene: Scene | None = None) -> dict[str, torch.Tensor]:
        """Instance, depth, flow and visibility, as stored, of a scene; of the clip's own, rendered once, where None."""
        if scene is not None:
            return self._geometry_of(scene)
        if self._geometry is None:
            self._geometry = self._geometry_of(self.scene)
        return self._geometry

    def _geometry_of(self, scene: Scene) -> dict[str, torch.Tensor]:
        instances, depths, flows, seen, last = [], [], [], [], None
        scene = scene.to(self.device)
        for t, camera in enumerate(self.cameras):
            after = self.cameras[t + 1] if t + 1 < len(self.cameras) else None
            wanted = ["instance", "depth"] + ["flow_prev"] * (t > 0) + ["flow_next"] * (after is not None)
            with torch.no_grad():
                frame = render_frame(scene, camera, tuple(wanted), self.cameras[t - 1] if t else None, after).to("cpu")
            assert frame.instance is not None and frame.depth is not None
            none = torch.full((camera.height, camera.width, 2), torch.nan)
            flow = none if frame.flow_prev is None else frame.flow_prev
            flows.append(flow)
            depths.append(frame.depth)
            instances.append(torch.where((frame.instance < 0) | (frame.instance >= NOWHERE), NOWHERE, frame.instance).to(torch.uint8))
            both = last is not None and frame.flow_prev is not None
            seen.append(visible(_first(flow), _first(last))[0, 0] if both and last is not None else torch.zeros(none.shape[:2]).bool())
            last = frame.flow_next
        return {
            "instance": torch.stack(instances),
            "depth": torch.stack(depths).to(torch.float16),
            "flow": torch.stack(flows).to(torch.float16),
            "visible": torch.stack(seen).to(torch.uint8),
        }

    def large(self) -> list[int]:
        """Instances that cover enough of the clip to be altered."""
        instance = self.geometry()["instance"]
        return [int(i) for i in instance.unique() if 0 < i < NOWHERE and (instance == i).float().mean() > SMALLEST]


def _first(flow: torch.Tensor) -> torch.Tensor:
    return flow.permute(2, 0, 1)[None]
