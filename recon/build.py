"""The public call: a log becomes a scene on disk."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from recon.album import keep_album
from recon.checkpoint import checkpoint_path, load_checkpoint, plain_config, plain_tracks, save_checkpoint
from recon.corrected import KINDS
from recon.exposed import exposed_by
from recon.fit.clear import Clear
from recon.fit.config import FitConfig
from recon.fit.fit import Fit
from recon.fit.flat import FlatGround
from recon.fit.limbs import Limbs
from recon.fit.model import MODEL, Knots
from recon.fit.motion import Motion
from recon.fit.population import Population
from recon.fit.run import run
from recon.fit.strides import stride_of
from recon.frames import Frames, check_size, load_frames
from recon.live import Live
from recon.log import Log, Track
from recon.memory import check_memory
from recon.offpath import held_out_sweeps, off_path_table, off_path_text
from recon.ready import fitted, moving_things, readied
from recon.report import held_out_table, table_text
from recon.seeds.triangulate import triangulated
from recon.skies import seen_sky
from recon.sky_told import under_their_sky
from recon.sound import check_path
from recon.start import Start, prepare
from recon.tracks import LIMBED
from render.progress import Progress
from scenes.asset import Actor, Asset
from scenes.atomic import atomic_folder
from scenes.camera import DARKEST, RigCamera
from scenes.files import save
from scenes.gaussians import Placed
from scenes.opening import check_device, fresh
from scenes.scene import Scene
from scenes.sky import Sky, linear_from_srgb
from scenes.space_order import space_order
from scenes.usd.scene import is_scene

PIXELS = 960 * 540
"""Of the pictures that are fitted, where nobody says."""
HELD_OUT = 8

SHARED, PER_PICTURE = (1_600, 170_000), (8, 700)
"""Steps that a fit takes and splats that it may have: for what a drive's pictures share, and for each of them besides. The 240 of three
cameras of drive 002 get 3,520 steps and 338,000 splats, the 400 of five 4,800 and 450,000. Two fifths fewer
splats cost the front camera among five 0.7 dB: what was wrong then was nearly as wrong in the pictures that were fitted to."""

MOST = 6500, 650_000
"""Of both, whatever the drive: a third and more beyond what five cameras of drive 002 get, whose fit takes a third of an hour."""

FEW, PER_PHOTO = (500, 30_000), (25, 2500)
"""The same where photos stand steps apart, in all and for each photo: little is shared by most of them. Without the former, 24 of a
street lose 0.2 dB at 416x312 and 0.3 at 831x624."""

APART = 0.12
"""Way from a photo to the next, in distances to what it shows, from which on they stand steps apart. A video's pictures do not (0.05 at 12
metres a second), and are fitted as a drive's."""

DROP = 0.2
"""Part of the splats that a step leaves out where photos stand steps apart."""


def reconstruct(
    log: Log,
    output: str | Path,
    cameras: Sequence[str] | None = None,
    start_us: int = 0,
    duration_us: int | None = None,
    size: tuple[int, int] | None = None,
    held_out: int = HELD_OUT,
    resume: bool = False,
    config: FitConfig | None = None,
    half: bool = False,
    overwrite: bool = False,
    device: str = "cpu",
) -> Scene:
    """Fit a scene to a log's images and write it to the folder `output`.

    cameras: the front ones where None. start_us, duration_us: the part of the drive. size: width and height of the first camera's
    pictures that are fitted (`size_like` has the others'), `fit_size` where None; config: `fit_config` where None. Every `held_out`th
    frame takes no part and is reported in `meta["held_out"]` and on stderr; neither does every `held_out`th lidar sweep, against which
    the scene is measured on the path and beside it (`meta["off_path"]`). An interrupted fit leaves `<output>.fit`, at most a minute old;
    `resume` goes on from it, with the same result as if it had never stopped.
    half: splats in half precision, where the file's size matters. overwrite: a scene that is there gives way once the new one is whole.
    device: where the fit runs and what is reported is rendered; one that was interrupted may go on elsewhere.

    The folder keeps the photos that were fitted to, too: the enhancer looks detail up there.

    Raises ValueError for data and options that do not fit, FileExistsError where `check_free` does, KeyboardInterrupt passed on.
    """
    output = check_free(output, resume, overwrite)
    check_device(device)
    began = time.monotonic()
    names, span = choose(log, cameras, start_us, duration_us)
    check_path(log, span)
    size, config = size or fit_size(log, names), config or fit_config(log, names, span)
    check_size(size)
    if size[0] > (first := log.camera(names[0])).width or size[1] > first.height:
        raise ValueError(f"--size {size[0]}x{size[1]} is more than {first.name} recorded, {first.width}x{first.height}; give that at most")
    options = {"log": log.name, "cameras": names, "span_us": list(span), "size": list(size), "held_out": held_out}
    options["config"] = plain_config(config)
    checkpoint = checkpoint_path(output)
    # a drive's folder is nobody's business whom its scene is given to
    held = options | {"folder": str(log.path.resolve()), "world_from_model": log.meta.get("world_from_model")}
    saved = load_checkpoint(checkpoint, held) if resume else None

    within = [s for s in held_out_sweeps(log, held_out) if span[0] <= s.time_us <= span[1]]
    for sweep in () if saved else within:
        sweep.read()  # they are used after the fit: a damaged one is told before it
    sweeps = fitted(log, held_out).sweeps_within(span)
    if not saved:
        check_memory(log, sweeps)
    known = (saved[1].get("path"), saved[1].get("movers")) if saved else (None, None)
    log = readied(log, sweeps, config, names, span, size, *known)
    unseen = {s.index for s in within}
    within = [s for s in log.sweeps if s.index in unseen]  # where the corrected path has them
    start, fit = begin(fitted(log, held_out), names, span, size, config, held_out, saved[0] if saved else None, device)
    if saved:
        fit.restore(saved[1])
    spent_before = float(saved[1].get("seconds", 0.0)) if saved else 0.0
    live = Live(fit, saved[1].get("live", ()) if saved else ())

    def seconds() -> float:
        return spent_before + time.monotonic() - began

    def keep() -> None:
        so_far = {"seconds": seconds(), "live": live.curve, "path": {kind: log.meta.get(kind) for kind in KINDS}}
        so_far["movers"] = plain_tracks(log.tracks) if "movers" in log.meta else None
        save_checkpoint(checkpoint, held, start, fit.tensors() | so_far)

    with Progress("fit", total=config.steps) as steps:
        steps.resume(fit.step_count)

        def report(fit: Fit) -> None:
            live.look(fit, seconds())
            steps.step(note="  ".join(filter(None, (str(live), f"loss {fit.recent_loss:.4f}", f"{len(fit.splats)} splats"))))

        run(fit, keep, report)
    keep()  # the report and the writing below may be interrupted too
    scene = assemble(fit, start, log, {"options": options})
    there = scene.to(device)
    rows = held_out_table(there, fit.frames, start.rig)
    scene.meta["held_out"] = rows
    scene.meta["fit"] = {"steps": config.steps, "splats": len(fit.splats), "seconds": round(seconds(), 1), "live": live.curve}
    print(table_text(rows), file=sys.stderr)
    if within:
        scene.meta["off_path"] = off_path_table(there, log, within, fit.frames)
        print(off_path_text(scene.meta["off_path"]), file=sys.stderr)
    with atomic_folder(output, overwrite) as whole, Progress("photos", total=len(fit.frames.training())) as steps:
        whole.rmdir()  # saving makes it; what is added is whole before anybody sees it
        save(scene, whole, half=half)
        keep_album(there, fit.frames, start.rig, whole, steps.step)
    checkpoint.unlink(missing_ok=True)
    return scene


def check_free(output: str | Path, resume: bool = False, overwrite: bool = False) -> Path:
    """A folder that a scene may be written to. FileNotFoundError where it would stand in none, FileExistsError where it is something else
    than a scene, or one that is not to be overwritten, and where it was begun and is neither to be resumed nor overwritten."""
    output = Path(output)
    fresh(output, overwrite)
    if output.exists() and not is_scene(output):
        raise FileExistsError(f"{output} is not a scene, so it is left alone; give another name with -o")
    begun = checkpoint_path(output)
    if begun.exists() and not (resume or overwrite):
        raise FileExistsError(f"{begun} is a fit that was interrupted; go on with it by --resume, or give -w to begin again")
    return output


def choose(
    log: Log, cameras: Sequence[str] | None = None, start_us: int = 0, duration_us: int | None = None
) -> tuple[list[str], tuple[int, int]]:
    """The cameras to fit, the front ones where None, and the span of time in microseconds. ValueError for what the log has not."""
    names = list(dict.fromkeys(cameras or log.front or list(log.cameras)[:1]))
    return names, _span(log, names, start_us, duration_us)


def fit_size(log: Log, names: Sequence[str]) -> tuple[int, int]:
    """Width and height to fit at: the first camera's own, shrunk to `PIXELS` where it has more."""
    camera = log.camera(names[0])
    shrink = min(1.0, (PIXELS / (camera.width * camera.height)) ** 0.5)
    return round(camera.width * shrink), round(camera.height * shrink)


def fit_config(log: Log, names: Sequence[str], span: tuple[int, int] | None = None) -> FitConfig:
    """How long and how finely to fit the pictures of `span`, all where None: the more there are, the longer and finer.

    Photos that stand steps apart (`APART`) are learnt by heart long before a drive's pictures are: colours that turn with the view, and
    many more than `PER_PHOTO` steps and splats each, improve the photos and nothing between them. Splats left out by lot do the reverse.
    """
    first, last = span or choose(log, names)[1]
    pictures = sum(int(((t >= first) & (t <= last)).sum()) for t in (log.camera(name).times_us for name in names))
    if _apart(log, names[0]) > APART:
        steps, splats = (min(base + n * pictures, most) for base, n, most in zip(FEW, PER_PHOTO, MOST, strict=True))
        return FitConfig(steps=steps, budget=splats, sh_degree=0, drop=DROP)
    steps, splats = (min(base + n * pictures, most) for base, n, most in zip(SHARED, PER_PICTURE, MOST, strict=True))
    return FitConfig(steps=steps, budget=splats)


def _apart(log: Log, name: str) -> float:
    """How far a camera's pictures lie apart, in distances to the points that they show: the median; 0 for a log that has none."""
    if log.points is None:
        return 0.0
    eyes = log.camera(name).world_from_cam[:, :3, 3].numpy()
    shown = [np.linalg.norm(log.points.xyz[points] - eye, axis=1) for points, eye in zip(log.points.seen[name], eyes, strict=True)]
    far = [float(np.median(d)) for d in shown if len(d)]
    steps = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
    return float(np.median(steps) / np.median(far)) if len(steps) and far else 0.0


def begin(
    log: Log,
    names: list[str],
    span: tuple[int, int],
    size: tuple[int, int],
    config: FitConfig,
    held_out: int = HELD_OUT,
    start: Start | None = None,
    device: str = "cpu",
    exposed: Mapping[str, RigCamera] | None = None,
) -> tuple[Start, Fit]:
    """What a fit starts from, prepared unless it is given, and the fit on a device before its first step.

    exposed: cameras by name as a scene has them, whose exposures and frames' gains are taken; estimated where None.
    """
    with Progress("images") as steps:
        asked = start is None and exposed is None and "gains" in config.refine  # else they are known
        frames = load_frames(log, names, span, size, held_out, steps.step, asked)
    if exposed is not None:
        frames = replace(frames, views=[replace(v, gain=exposed[names[v.camera]].gain_at(v.time_us)) for v in frames.views])
    if start is not None:
        told = zip(frames.views, start.gains, start.skies, strict=True)
        frames = replace(frames, views=[replace(v, gain=gain, sky=sky) for v, gain, sky in told])
        return start, _fit(frames, start, Clear.of(log, span, start.ground), config, device)
    sparse = log.points
    if sparse is None and not log.sweeps_within(span):
        sparse = triangulated(log, frames)
        frames = replace(frames, views=under_their_sky(log, names, frames.views, sparse))
        if asked:
            frames = replace(frames, views=exposed_by(sparse, log, names, frames.views))
    with Progress("prepare") as steps:
        coefficients = (config.sh_degree + 1) ** 2
        known = None if exposed is None else torch.stack([exposed[name].exposure for name in names])
        start = prepare(log, frames, span, config.budget, coefficients, lambda what: steps.step(note=what), sparse, known)
    if sparse is not None and not log.tracks:
        print(
            f"{log.path} has neither boxes nor lidar: its pictures show {moving_things(len(start.tracks))} along the street",
            file=sys.stderr,
        )
    return start, _fit(frames, start, Clear.of(log, span, start.ground), config, device)


def _span(log: Log, names: list[str], start_us: int, duration_us: int | None) -> tuple[int, int]:
    """First and last moment, counted from the first frame of the first camera."""
    times = log.camera(names[0]).times_us
    for name in names:
        log.camera(name)
    length = int(times[-1] - times[0])
    if not 0 <= start_us <= length:
        raise ValueError(f"start {start_us / 1e6:g}s is outside the drive, which lasts {length / 1e6:g}s")
    if duration_us is not None and duration_us <= 0:
        raise ValueError(f"duration {duration_us / 1e6:g}s must be positive; the drive lasts {length / 1e6:g}s")
    # the cameras of a rig fire up to a tenth of a second apart: half a step around keeps whole frames together
    slack = int(times.diff().double().median()) // 2 if len(times) > 1 else 0
    first = int(times[0]) + start_us
    last = int(times[-1]) if duration_us is None else min(int(times[-1]), first + duration_us - 2 * slack)
    return first - slack, max(last, first) + slack


def _fit(frames: Frames, start: Start, clear: Clear, config: FitConfig, device: str) -> Fit:
    trained = torch.tensor([v.time_us for v in frames.of(0)])
    motion = Motion(frames, start.rig, Knots(start.ego, trained), start.tracks)
    limbed = [(i + 1, t) for i, t in enumerate(start.tracks) if t.label in LIMBED and "limbs" in config.refine]
    strides = {group: stride for group, track in limbed if (stride := stride_of(track, frames, motion))}
    times = [v.time_us for v in frames.views]
    limbs = Limbs(strides, start.tracks, (min(times), max(times)), device)
    ground = FlatGround(start.ground, start.ground_shown, torch.device(device))
    population = Population(start.splats.to(device), motion, config, ground, start.swept, clear)
    return Fit(frames, population, start.sky, start.exposures, limbs, start.measured)


def assemble(fit: Fit, start: Start, log: Log, extra: dict | None = None) -> Scene:
    """The scene that a fit's present state stands for, on the host."""
    groups = [g.detach().to("cpu") for g in fit.splats.groups(fit.sh_count())]
    rig = {}
    for c, name in enumerate(fit.frames.names):
        mount, times = fit.motion.mounted(c, [v.time_us for v in fit.frames.views if v.camera == c])
        r = start.rig[name]
        gains = [v.gain.cpu() for v in fit.frames.views if v.camera == c and v.gain is not None]
        exposure = fit.exposures[c].detach().cpu().clone()
        rig[name] = RigCamera(r.lens, r.width, r.height, mount, exposure, times, gains=torch.stack(gains) if gains else None)
    share = {k: log.meta[k] for k in ("licence", "attribution", "source") if k in log.meta}
    actors = []
    for i, (track, gaussians) in enumerate(zip(start.tracks, groups[1:], strict=True)):
        trajectory = fit.motion.trajectory(i)
        meta = {**share, "track": track.name}
        deformation = fit.limbs.of[i + 1].deformation() if i + 1 in fit.limbs.of else None
        asset = Asset(gaussians, torch.from_numpy(track.size), track.label, MODEL, meta)
        actors.append(Actor(asset, trajectory, track.name, deformation))
    parked = [
        {"track": t.name, "label": t.label, "size": t.size.tolist(), "world_from_box": middle_pose(t).tolist()}
        for t in log.tracks
        if not t.moving and t.name.startswith("veh")
    ]
    sky = Sky(linear_from_srgb(fit.sky.detach().cpu().clamp(0, brightest(rig.values()))))
    background = Placed(groups[0].select(space_order(groups[0].means)), torch.eye(4, dtype=torch.float64))
    movers = {"movers": "found in pictures"} if actors and not log.tracks else {}
    meta = {**log.meta, **movers, "parked": parked, **(extra or {})}
    scene = Scene(background, tuple(actors), sky, fit.motion.path(), rig, MODEL, start.ground, meta)
    return replace(scene, sky=seen_sky(scene.to(fit.device), fit.openings.hidden))


def brightest(rig: Iterable[RigCamera]) -> float:
    """What a scene may show at most, in the colours of its first camera: the darkest picture that any camera took shows it as 1, and clips
    what is brighter."""
    most = 1.0
    for camera in rig:
        gain, offset = camera.exposure[:, :3].sum(1), camera.exposure[:, 3]
        frames = torch.ones(1, 3) if camera.gains is None else camera.gains
        most = max(most, float(((1 / frames - offset) / gain.clamp_min(DARKEST)).max()))
    return most


def middle_pose(track: Track) -> torch.Tensor:
    """A standing box's pose: that of its middle observation."""
    return track.world_from_box[len(track.world_from_box) // 2]
