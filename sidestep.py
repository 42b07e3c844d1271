"""The front door: `sidestep COMMAND`, one dataclass each. The main job stands here; commands about one package in its commands.py.

Exit codes: 0 done, 1 bad data, or words that do not fit it (one line says what, where and the fix; SIDESTEP_TRACEBACK=1 shows where it came
from), 2 usage: words that are wrong whatever the data, 130 interrupted, 143 stopped by SIGTERM.
"""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, Union

import tyro
from tyro.conf import UseAppendAction, subcommand

from enhance.commands import Enhance, Pairs, Train
from enhance.demo import Demo
from enhance.doctor import Doctor
from recon.commands import ACTIONS, Assets, Recon
from render.outputs import check_scene_outputs
from scenes.commands import Convert, Edit, Info, Validate
from scenes.names import unknown
from scenes.opening import UsageError, check_device, fresh, open_scene, open_view
from scenes.options import (
    Angle,
    Axis,
    FileOrNone,
    Flag,
    Insertion,
    Lateral,
    OneOfRig,
    Output,
    Overwrite,
    Place,
    Rate,
    ScenePath,
    Size,
    Speed,
    Time,
    TimeOrAll,
    Way,
    names,
    written,
)
from scenes.placement import Placement
from scenes.warnings import Undisturbed, warn

if TYPE_CHECKING:
    from torch import Tensor

    from render.record import Stages
    from scenes.scene import Scene
    from scenes.trajectory import Trajectory

Outputs = Annotated[tuple[str, ...], written(lambda text: check_scene_outputs(names(text)), "NAME,NAME", "none")]


@dataclass
class Insert:
    """Insert an asset into a scene, as a layer that leaves the rest of the scene untouched."""

    scene: ScenePath
    """Scene folder."""
    asset: str
    """The asset, as car/0003."""
    at: Place = None
    """Metres forward and left of the recording car at --start, as 20m,-3.5m."""
    yaw: Angle = 0.0
    """Heading relative to the recording car's, counter-clockwise, as 5deg."""
    speed: Speed = 0.0
    """Speed along its heading, as 8m/s."""
    path: Way = "straight"
    """straight: along its heading; lane: parallel to the recorded path, to which --yaw is then relative (180deg for oncoming traffic)."""
    trajectory: FileOrNone = None
    """CSV file with the header time_s,x_m,y_m[,yaw_deg], instead of --at, --yaw, --speed and --path: seconds from --start, metres forward
    and left of the recording car at --start."""
    start: Time = 0
    """Time from the start of the drive at which the asset is at --at."""
    databank: Path = Path("databank")
    """Folder of the databank."""

    def run(self) -> None:
        if (self.at is None) == (self.trajectory is None):
            raise UsageError("give the asset's place with --at X,Y, as --at 20m,-3.5m, or its path with --trajectory t.csv; one of the two")
        if self.trajectory is not None and (self.yaw or self.speed or self.path != "straight"):
            raise UsageError("--trajectory also gives heading and speed; leave out --yaw, --speed and --path")
        from scenes import Databank
        from scenes.alone import alone
        from scenes.insert import insert
        from scenes.seen import seeing, unseen_warning
        from scenes.usd.edit import add_edit

        placement = Placement(self.asset, *(self.at or (0.0, 0.0)), self.yaw, self.speed, self.path, self.trajectory)
        straight = {"at_m": self.at, "yaw_rad": self.yaw, "speed_m_s": self.speed, "path": self.path}
        way = straight if self.trajectory is None else {"trajectory": self.trajectory.name}
        about = {"kind": "insert", "asset": self.asset, **way}
        asset = Databank(self.databank).load(self.asset)
        with alone(self.scene):  # the track's name is free of what the scene has
            scene, _ = open_scene(self.scene)
            result = insert(scene, asset, placement, int(scene.ego.times_us[0]) + self.start)
            recorded = [scene.camera(name, int(t)) for name in scene.rig for t in scene.frame_times(name)]
            warnings = [*result.warnings, *unseen_warning(result.actor, seeing(result.actor, recorded))]
            add_edit(self.scene, result.actor.track, [result.actor], about)  # last: who stops meanwhile has changed nothing
        warn(warnings)
        layer = self.scene / "edits" / f"{result.actor.track}.usda"
        fix = f"sidestep edit {quote(str(self.scene))} --undo {result.actor.track}"
        print(f"inserted {self.asset} as {result.actor.track}; {layer} holds the edit: delete it, or {fix}, to undo it")


@dataclass
class Render:
    """Render a clip of a scene from a shifted path, with inserted assets, enhanced: an H.264 video and a JSON report."""

    scene: ScenePath
    """Scene folder, or a splat file or asset."""
    output: Output
    """Video to write, as out.mp4; the report goes to out.json."""
    camera: OneOfRig = None
    """Camera of the rig, as front_camera; the scene's first by default. For a splat file: orbit, which circles it. Or a camera of your own,
    as roof.json: a JSON file with any of like (a camera of the rig: what is not said is as of that), moved_m ([forward, left, up] from
    there), height_m (above the ground), yaw_deg (to the left), pitch_deg (up) and roll_deg (to the right) to the car's axes,
    angle_of_view_deg (across), size ([width, height]), lens (pinhole or fisheye); calibrated: fx, fy, cx, cy, size and distortion in
    OpenCV's order."""
    up: Axis = None
    """Up axis of a splat file: x, -x, y, ...; by default y for .glb and .spz, what a USD file says, else z. Splats trained from photos
    mostly have -y."""
    lateral_shift: Lateral = 0.0
    """Metres to the left of the recorded path, as 2m; -2m is to the right. 0m@2s,3.5m@5s changes lane from 2 to 5 seconds after the clip's
    first frame."""
    trajectory: FileOrNone = None
    """CSV file with the header time_s,x_m,y_m[,yaw_deg]: a path of its own for the recording car, in seconds from the clip's first frame,
    and metres forward and left of the recorded car there."""
    insert: UseAppendAction[tuple[Insertion, ...]] = ()
    """An asset to insert for this clip, as car/0003@12m,3.5m,yaw=5deg,speed=8m/s or car/0003@trajectory=t.csv; metres forward and left
    of the recording car at the clip's first frame."""
    enhance: Flag = False
    """Repair and harmonize the frames, with detail from the photos that the scene keeps."""
    weights: str = "builtin"
    """The enhancer's weights: builtin, a file that sidestep train wrote, or a public model's: Harmonizer, Fixer, Difix, Cosmos-Predict2."""
    no_shadows: Flag = False
    """Do not render the shadows of inserted assets."""
    start: Time = 0
    """Start time, from the camera's first frame."""
    duration: TimeOrAll = None
    """Duration of the clip."""
    fps: Rate = None
    """Frames per second, evenly spaced; by default the frames have their recorded times."""
    size: Size = None
    """Size in pixels, as 640x360."""
    outputs: Outputs = ()
    """Buffers to write to the folder out/, one file a frame: any of rgb, alpha, depth, median_depth, normal, instance, instance_alpha,
    flow_prev, flow_next, visible_prev, visible_next, need."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to render and enhance."""
    databank: Path = Path("databank")
    """Folder of the databank."""
    drop_invalid: Flag = False
    """Leave out splats with values that are not finite, and count them, instead of refusing the scene."""
    overwrite: Overwrite = False
    """Replace existing files."""

    def run(self) -> None:
        fresh(self.output, self.overwrite)
        from render.video import check_container, odd_warning

        check_container(self.output)  # now: to open a scene, what is put in and its photos takes long
        own = Path(self.camera) if self.camera is not None and self.camera.lower().endswith(".json") else None
        report = self.output.with_suffix(".json")
        if own is not None and own.exists() and report.exists() and own.samefile(report):
            raise UsageError(f"{report} is the camera's file, and {self.output}'s report would replace it; give another name with -o")
        for path in (report, *([self.output.with_suffix("")] if self.outputs else [])):
            fresh(path, self.overwrite)
        if self.weights != "builtin" and not self.enhance:
            raise UsageError(f"--weights {self.weights} have no effect without --enhance; add it, or leave out --weights")
        if self.trajectory is not None and self.lateral_shift:
            raise UsageError("--trajectory is the whole path; leave out --lateral-shift, or add it to the file's y_m")
        from render.aside import path_warning, sight_warning
        from render.clip import clip_cameras, clip_times, cut_warning
        from render.record import record, stale_warning
        from scenes import Databank
        from scenes.files import kind_of
        from scenes.insert import insert
        from scenes.own_camera import described, own_camera
        from scenes.seen import absence_warning, seeing, unseen_warning
        from scenes.trajectory import Trajectory

        check_device(self.device)
        asked = {f"--camera {own}": own, "--insert": self.insert or None, "--trajectory": self.trajectory}
        needs_path = [option for option, value in asked.items() if value is not None]
        if needs_path and kind_of(self.scene) in ("asset", "splats"):
            told = "needs a scene that sidestep recon wrote, with a ground and a path"
            raise UsageError(f"{needs_path[0]} {told}; {self.scene} holds splats only")
        scene, warnings = open_view(self.scene, self.drop_invalid, self.up)
        camera = next(iter(scene.rig), "camera") if self.camera is None else self.camera
        if own is not None:
            scene = replace(scene, own={camera: own_camera(scene, own)})
        times = clip_times(scene, camera, self.start, self.duration, self.fps)
        way, said, notes = self._path(scene, times)
        cameras = clip_cameras(scene, camera, way, times)
        warnings += notes
        warnings += cut_warning(scene, camera, self.start, self.duration)
        ego = way if isinstance(way, Trajectory) else scene.ego.shifted(lateral=way)
        put_in: set[str] = set()
        for placement in self.insert:
            asset = Databank(self.databank).load(placement.asset)
            result = insert(scene, asset, placement, int(times[0]), int(times[-1]), ego)
            scene, warnings = result.scene, [*warnings, *result.warnings]
            put_in.add(result.actor.track)
        warnings += path_warning(scene, clip_cameras(scene, camera, 0.0, times), way, said)
        warnings += sight_warning(scene, camera, cameras) if own is not None else []
        for actor in (a for a in scene.actors if not a.recorded):  # those of edits too: a shift may show another side of them
            witnesses = seeing(actor, cameras)
            warnings += absence_warning(actor, cameras, witnesses) if actor.track in put_in else []
            warnings += unseen_warning(actor, witnesses)
        warnings += odd_warning(self.output, *(self.size or (cameras[0].width, cameras[0].height)))
        warnings += stale_warning(self.output, self.outputs)
        warn(warnings)
        width, height = self.size or (None, None)
        stages: Stages = {}
        needs: tuple[str, ...] = ()
        scene = scene.to(self.device)
        facts: dict[str, object] = {"scene": str(self.scene), "path": said, "enhanced": self.weights if self.enhance else None}
        if own is not None:
            facts["camera_file"] = described(own)
        if self.enhance:
            from enhance.clip import enhancement
            from render.album import references_of

            references = references_of(self.scene, scene)
            stages, needs = enhancement(self.weights, self.device, references, scene)
            facts["photos"] = len(references.shots) if references else 0
        record(
            scene, camera, self.output, shift=way, times_us=times, width=width, height=height, keep=self.outputs,
            shadows=not self.no_shadows, stages=stages, needs=needs, facts=facts, warnings=warnings,
        )  # fmt: skip
        written = [self.output, report, *([self.output.with_suffix("")] if self.outputs else [])]
        print(f"wrote {', '.join(map(str, written))}")

    def _path(self, scene: Scene, times: Tensor) -> tuple[float | Trajectory, str, list[str]]:
        """The recording car's path for a clip, as `render_clip` takes it, what asked for it, and what to tell of it."""
        from scenes.ego_path import changing_lane, driven
        from scenes.metres import require_metres

        if self.trajectory is not None:
            path, notes = driven(scene, self.trajectory, int(times[0]), int(times[-1]))
            return path, f"--trajectory {self.trajectory}", notes
        if isinstance(self.lateral_shift, float):
            return self.lateral_shift, f"--lateral-shift {self.lateral_shift:g}m" if self.lateral_shift else "as recorded", []
        require_metres(scene, "a lateral shift")
        said = ",".join(f"{k.left:g}m@{k.time_us / 1e6:g}s" for k in self.lateral_shift)
        path, notes = changing_lane(scene.ego, self.lateral_shift, int(times[0]), int(times[-1]))
        return path, f"--lateral-shift {said}", notes


DESCRIPTION = (
    "Reconstruct a recorded drive as Gaussian splats, render it from beside its path with inserted assets, and enhance the clip. "
    "sidestep --version says which Sidestep this is."
)
COMMANDS = {
    "recon": Recon, "assets": Assets, "insert": Insert, "edit": Edit, "render": Render, "pairs": Pairs, "train": Train, "enhance": Enhance,
    "convert": Convert, "info": Info, "validate": Validate, "doctor": Doctor, "demo": Demo,
}  # fmt: skip


def parse(words: list[str]) -> Any:
    """The command that the words say; prints help, the version or what is wrong and exits where they say none."""
    program, commands = "sidestep", dict[str, Any](COMMANDS)
    if words == ["--version"]:
        print(f"sidestep {_version()}")
        sys.exit(0)
    if len(words) > 1 and words[0] == "assets" and not words[1].startswith("-"):
        program, commands, words = "sidestep assets", ACTIONS, words[1:]
    if words and not words[0].startswith("-"):
        if words[0] not in commands:
            fail(unknown("command", words[0], program, commands), 2)
        # tyro builds the one command that is asked for, whose help its errors name: building all takes most of the time of an error
        return tyro.cli(commands[words[0]], prog=f"{program} {words[0]}", args=words[1:])
    choices: Any = Union[tuple(Annotated[c, subcommand(name)] for name, c in COMMANDS.items())]  # noqa: UP007 - made at run time
    return tyro.cli(choices, prog="sidestep", description=DESCRIPTION, args=words)


def _version() -> str:
    try:
        return version("sidestep")
    except PackageNotFoundError:
        return "unknown: run from a source tree that was never installed"


def _open_streams() -> None:
    """Open what the caller closed of the standard streams, as `2>&-` does, to nowhere: the next files to be opened would get their numbers,
    and what libraries write there. Nor does a stderr that takes no words, as a log on a full disk, cost the work that they tell of."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115 - for as long as the process runs
    if (said := sys.__stderr__) and said is sys.stderr:  # and nobody's who called `main`
        raw: Any = getattr(said.buffer, "raw", said.buffer)  # Python's -u knows no buffer
        sys.stderr = io.TextIOWrapper(io.BufferedWriter(Undisturbed(raw)), said.encoding, said.errors, line_buffering=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit."""
    _open_streams()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that half-written files are removed on the way out
    try:
        parse(list(sys.argv[1:] if arguments is None else arguments)).run()
    except UsageError as error:
        fail(error, 2)
    except KeyboardInterrupt as stop:
        fail(stop if str(stop) else "interrupted", 130)
    except BrokenPipeError:
        os._exit(1)  # whoever read our output has gone: there is nobody left to tell
    except (MemoryError, RuntimeError) as error:
        if not lacks_memory(error) or os.environ.get("SIDESTEP_TRACEBACK"):
            raise
        fail("there is not enough memory for that; give a smaller --size, or fewer --outputs, or stop what else runs", 1)
    except (ValueError, OSError) as error:
        if os.environ.get("SIDESTEP_TRACEBACK"):
            raise
        fail(told(error), 1)


def told(error: Exception) -> str:
    """What an error says, where, and with its notes; of a disk that is full, also the fix."""
    if not isinstance(error, OSError) or not error.strerror:
        return str(error)
    fix = ["make room there"] * (error.errno in (errno.ENOSPC, errno.EDQUOT))
    return "; ".join([f"{error.filename or 'the disk'}: {error.strerror}", *fix, *getattr(error, "__notes__", [])])


def lacks_memory(error: Exception) -> bool:
    """Whether an error says that memory ran out: numpy's and Python's by its type, torch's on a CPU by its words alone."""
    words = ("allocate memory", "out of memory", "Failed to allocate")
    return isinstance(error, MemoryError) or any(said in str(error) for said in words)


def fail(said: object, code: int) -> NoReturn:
    print("sidestep: " + " ".join(str(said).split()), file=sys.stderr)
    sys.exit(code)


if __name__ == "__main__":
    main()
