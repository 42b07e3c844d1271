"""A clip: one camera of a scene along a path, frame by frame, in constant memory."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from numbers import Real

import torch

from render.frame import DEFAULT, render_frame
from render.frame_types import Frame, RenderConfig
from render.outputs import check_scene_outputs
from render.room import Room, one_ahead
from scenes.camera import Camera
from scenes.files import splats_of
from scenes.metres import require_metres
from scenes.scene import Scene
from scenes.trajectory import Trajectory, whole_times


def render_clip(
    scene: Scene,
    camera: str,
    shift: float | Trajectory = 0.0,
    times_us: Sequence[int] | torch.Tensor | None = None,
    width: int | None = None,
    height: int | None = None,
    outputs: tuple[str, ...] = ("rgb",),
    shadows: bool = True,
    config: RenderConfig = DEFAULT,
) -> Iterator[Frame]:
    """The frames that a camera of the rig takes along a path; a stream, one frame in memory at a time, two on CUDA.

    shift: metres to the left of the recorded path (negative: right), or any other path of the body.
    times_us: when; the camera's own frame times by default. width, height: pixels, the camera's own by default.
    The first frame has no flow_prev and the last no flow_next: they are None.
    Raises ValueError, before the first frame, for an unknown camera or output, no times, a time off the path, or a shift of a scene
    that is not metric.
    """
    cameras = clip_cameras(scene, camera, shift, times_us, width, height)
    outputs = check_scene_outputs(outputs)
    return _frames(scene, cameras, outputs, shadows, config)


def clip_cameras(
    scene: Scene,
    camera: str,
    shift: float | Trajectory = 0.0,
    times_us: Sequence[int] | torch.Tensor | None = None,
    width: int | None = None,
    height: int | None = None,
) -> list[Camera]:
    """The cameras of a clip; see `render_clip`."""
    rig_camera = scene.rig_camera(camera)
    if (width is None) != (height is None):
        raise ValueError("width and height go together; give both or neither")
    if width is not None and height is not None:
        rig_camera = rig_camera.resized(width, height)
    if isinstance(shift, Trajectory):
        ego = shift
    elif isinstance(shift, Real | torch.Tensor) and math.isfinite(shift):
        if shift != 0:
            require_metres(scene, "a lateral shift")
        ego = scene.ego.shifted(lateral=shift)
    else:
        raise ValueError(f"shift must be a finite number of metres to the left, or a Trajectory, got {shift!r}")
    times = scene.frame_times(camera) if times_us is None else whole_times(times_us)
    if times.ndim != 1:
        raise ValueError(f"times_us must be a list of times, as [t] of one, got {times_us!r}")
    if len(times) == 0:
        raise ValueError(f"a clip of {camera} needs at least one frame, got no times")
    return [rig_camera.along(ego, int(t)) for t in times]


def clip_times(scene: Scene, camera: str, start_us: int = 0, duration_us: int | None = None, fps: float | None = None) -> torch.Tensor:
    """int64 `[F]`: the camera's frame times from `start_us` after its first one, for `duration_us`; evenly at `fps` where given.

    Its own frame times are taken from `_slack` before the start until `_slack` before the end: stamps that shake neither add one nor drop
    one. ValueError where nothing is left, naming what the camera has.
    """
    have = scene.frame_times(camera)
    first, last = int(have[0]), int(have[-1])
    has = f"{camera} has {len(have)} frames over {(last - first) / 1e6:.3g}s"
    if start_us < 0:
        raise ValueError(f"--start {start_us / 1e6:g}s lies before the first frame: {has}; begin at 0s or later")
    begin = first + start_us
    slack = _slack(have)
    end = last + slack if duration_us is None else begin + duration_us - 1
    if fps is not None:
        times = _evenly(begin, min(end, last), fps)
    else:  # what lasts shorter than the slack has the frame at its start all the same
        times = have[(have >= begin - slack) & (have <= max(end - slack, min(end, begin + slack))) & (end >= begin)]
    if len(times) == 0:
        asked = f"--start {start_us / 1e6:g}s" + ("" if duration_us is None else f" --duration {duration_us / 1e6:g}s")
        raise ValueError(f"{asked} leaves no frame: {has}; start before that and last at least 100ms")
    return times


def cut_warning(scene: Scene, camera: str, start_us: int, duration_us: int | None) -> list[str]:
    """What to tell of a clip that would last longer than the recording does: a sentence, or nothing."""
    have = scene.frame_times(camera)
    left = int(have[-1]) - int(have[0]) - start_us + 1e6 / frame_rate(have)  # its last frame is shown as long as others
    if duration_us is None or duration_us <= left + _slack(have):
        return []
    return [f"--duration {duration_us / 1e6:g}s goes beyond the recording: {camera} has {left / 1e6:.1f}s from there, and so the clip"]


def _slack(times_us: torch.Tensor) -> int:
    """Microseconds by which frame times may shake about even ones: a quarter of a step."""
    return round(250_000 / frame_rate(times_us))


def frame_rate(times_us: torch.Tensor) -> float:
    """Frames a second of a clip with these times: by the median step, 10 for a single frame."""
    return 10.0 if len(times_us) < 2 else 1e6 / float(times_us.diff().double().median())


def uneven(times_us: torch.Tensor) -> bool:
    """Whether a frame is shown half as long again as most are: a clip's frames are dated then, and evenly apart else, jitter or not."""
    steps = times_us.diff().double()
    return len(steps) > 0 and bool(steps.max() > 1.5 * steps.median())


def _evenly(begin: int, end: int, fps: float) -> torch.Tensor:
    if not fps > 0:
        raise ValueError(f"--fps must be positive, got {fps:g}")
    count = int((end - begin) * fps / 1e6) + 1 if end >= begin else 0
    return begin + (torch.arange(count, dtype=torch.float64) * 1e6 / fps).round().long()


def _frames(scene: Scene, cameras: list[Camera], outputs: tuple[str, ...], shadows: bool, config: RenderConfig) -> Iterator[Frame]:
    last = len(cameras) - 1

    def draw(i: int) -> Frame:
        wanted = tuple(o for o in outputs if not (o.endswith("_prev") and i == 0) and not (o.endswith("_next") and i == last))
        previous = cameras[i - 1] if i > 0 else None
        following = cameras[i + 1] if i < last else None
        return render_frame(scene, cameras[i], wanted, previous, following, shadows, config, room)

    splats = [g for _, g in splats_of(scene)]
    gradients = torch.is_grad_enabled() and any(t.requires_grad for g in splats for t in g.tensors().values())
    room = Room() if splats[0].device.type == "cuda" and not gradients else None
    yield from map(draw, range(len(cameras))) if room is None else one_ahead(draw, range(len(cameras)), room)
