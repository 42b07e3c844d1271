"""The main job's last step: a stream of frames becomes a video, a report, and on request the frames themselves."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from importlib.metadata import PackageNotFoundError, version
from io import BytesIO
from pathlib import Path

import numpy as np
import torch

from render.clip import clip_cameras, frame_rate, render_clip, uneven
from render.frame_types import Frame
from render.outputs import OUTPUTS
from render.progress import Progress, Stopwatch
from render.video import VideoWriter, write_image
from scenes.atomic import atomic_file, atomic_folder
from scenes.scene import Scene
from scenes.trajectory import Trajectory

SEED = 0
Stages = Mapping[str, Callable[[Iterator[Frame]], Iterator[Frame]]]


def record(
    scene: Scene,
    camera: str,
    path: Path,
    *,
    shift: float | Trajectory = 0.0,
    times_us: torch.Tensor | None = None,
    width: int | None = None,
    height: int | None = None,
    keep: Sequence[str] = (),
    shadows: bool = True,
    stages: Stages | None = None,
    needs: Sequence[str] = (),
    facts: dict | None = None,
    warnings: Sequence[str] = (),
) -> dict:
    """Render a clip to `path` (H.264) and its report to the same name with .json; return the report.

    keep: outputs that also go, frame by frame, into a folder of the same name: rgb as PNG, all others as .npy.
    stages: by name what happens to the stream of frames before it is written, such as enhancement, one after the other. needs: outputs
    that they read.
    facts: what else the report should say. Frames are streamed, and all files appear together at the end or not at all.
    Existing files are replaced; whether they may be is the caller's question. A folder that is not one of kept frames is never
    replaced: FileExistsError.
    """
    if keep:
        _check_replaceable(path.with_suffix(""))
    torch.manual_seed(SEED)
    cameras = clip_cameras(scene, camera, shift, times_us, width, height)
    times = torch.tensor([c.time_us for c in cameras])
    fps = frame_rate(times)
    moments = (times - times[0]).tolist() if uneven(times) else [None] * len(times)
    watch = Stopwatch()
    outputs = tuple(dict.fromkeys(("rgb", *keep, *needs)))
    frames = watch.during("render", render_clip(scene, camera, shift, times, width, height, outputs, shadows))
    for name, work in (stages or {}).items():
        frames = watch.during(name, work(frames))

    with ExitStack() as files:
        report_path = files.enter_context(atomic_file(path.with_suffix(".json")))
        folder = files.enter_context(atomic_folder(path.with_suffix(""), replace=True)) if keep else None
        video = files.enter_context(VideoWriter(path, fps, cameras[0].width, cameras[0].height))
        steps = files.enter_context(Progress(f"render {path.name}", len(cameras)))
        for index, frame in enumerate(frames):
            assert frame.rgb is not None
            with watch.stage("write"):
                video.write(frame.rgb, moments[index])
                if folder is not None:
                    _keep(folder, index, frame, keep)
            steps.step()
        report = {
            "versions": versions(),
            "seed": SEED,
            "scene": scene.meta.get("name"),
            "attribution": scene.meta.get("attribution"),
            "camera": camera,
            "body_from_cam": scene.rig_camera(camera).body_from_cam.tolist(),
            "lens": {"type": type(cameras[0].lens).__name__, "params": cameras[0].lens.params().tolist()},
            "size": [cameras[0].width, cameras[0].height],
            "fps": round(fps, 6),
            "lateral_shift_m": shift if isinstance(shift, int | float) else None,
            "shadows": shadows,
            "inserted": _inserted(scene),
            **(facts or {}),
            "ms_per_frame": watch.milliseconds(len(cameras)),
            "warnings": list(warnings),
            "frames": [{"time_us": c.time_us, "world_from_cam": c.world_from_cam.tolist()} for c in cameras],
        }
        report_path.write_text(report_text(report))
    return report


def report_text(report: dict) -> str:
    """JSON with one frame a line, so that a report of a long clip can be read and compared."""
    head = {key: value for key, value in report.items() if key != "frames"}
    lines = [f"  {json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}" for key, value in head.items()]
    if "frames" in report:
        rows = ",\n".join(f"    {json.dumps(row)}" for row in report["frames"])
        lines.append(f'  "frames": [\n{rows}\n  ]')
    return "{\n" + ",\n".join(lines) + "\n}\n"


def versions() -> dict[str, str]:
    """What computed it: Sidestep, Python and the packages whose versions can change a pixel."""
    found = {"python": platform.python_version(), "machine": f"{platform.system()} {platform.machine()}"}
    for package in ("sidestep", "torch", "warp-lang", "av", "numpy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # run from a source tree that was never installed
            found[package] = "unknown"
    return found


def stale_warning(path: Path, keep: Sequence[str]) -> list[str]:
    """What to tell of frames that an earlier clip of this name kept, where the one at `path` keeps none instead: a sentence, or none."""
    folder = path.with_suffix("")
    if keep or not folder.is_dir() or not _holds_frames(folder):
        return []
    return [f"{folder} holds frames of an earlier clip, not of this {path.name}; --outputs keeps this one's there"]


def _holds_frames(folder: Path) -> bool:
    """Whether a folder holds kept frames and nothing else."""
    names = [entry.name for entry in folder.iterdir()]
    return bool(names) and all(name in OUTPUTS for name in names)


def _check_replaceable(folder: Path) -> None:
    """FileExistsError where `folder` holds anything but kept frames: scenes/s1 stands where the frames of scenes/s1.mp4 would go."""
    if folder.exists() and not (folder.is_dir() and (_holds_frames(folder) or not any(folder.iterdir()))):
        raise FileExistsError(f"{folder} holds something else than kept frames, so it is left alone; give another name with -o")


def _keep(folder: Path, index: int, frame: Frame, keep: Sequence[str]) -> None:
    for name in keep:
        value = getattr(frame, name)
        if value is None:
            continue  # the first frame has no flow_prev, the last no flow_next
        (folder / name).mkdir(exist_ok=True)
        if name == "rgb":
            write_image(folder / name / f"{index:06d}.png", value)
        else:
            whole = BytesIO()  # written by Python, which says that the disk is full; numpy says "36864 requested and 20448 written"
            np.save(whole, value.detach().cpu().numpy())
            (folder / name / f"{index:06d}.npy").write_bytes(whole.getbuffer())


def _inserted(scene: Scene) -> list[dict]:
    return [
        {
            "track": actor.track,
            "label": actor.asset.label,
            "instance": i + 1,
            "size_m": actor.asset.size.tolist(),
            "times_us": [int(actor.trajectory.times_us[0]), int(actor.trajectory.times_us[-1])],
            "world_from_asset": [actor.trajectory.world_from_body[0].tolist(), actor.trajectory.world_from_body[-1].tolist()],
        }
        for i, actor in enumerate(scene.actors)
        if not actor.recorded
    ]
