"""The whole reconstruction, in its order: a log becomes a scene on disk."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from recon.album import keep_album
from recon.assemble import assemble
from recon.begin import begin
from recon.checkpoint import checkpoint_path, load_checkpoint, plain_config, plain_tracks, save_checkpoint
from recon.defaults import HELD_OUT, choose, fit_config, fit_size
from recon.evaluation.live import Live
from recon.evaluation.offpath import held_out_sweeps, off_path_table, off_path_text, shifts_within
from recon.evaluation.report import held_out_table, table_text
from recon.fit.config import FitConfig
from recon.fit.fit import Fit
from recon.fit.run import run
from recon.log import Log
from recon.memory import check_memory
from recon.ready import fitted, readied, same_sweeps
from recon.registration.corrected import KINDS
from recon.sound import check_path
from recon.start import Start
from recon.views.frames import check_size
from render.progress import Progress
from scenes.atomic import atomic_folder
from scenes.files import save
from scenes.opening import check_device, fresh
from scenes.scene import Scene
from scenes.usd.metadata import is_scene


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
    overwrite: bool = False,
    device: str = "cpu",
    effort: float = 1.0,
) -> Scene:
    """Fit a scene to a log's images and write it to the folder `output`.

    cameras: the front ones where None. start_us, duration_us: the part of the drive. size: width and height of the first camera's pictures
    that are fitted (`size_like` has the others'), `fit_size` where None; config: `fit_config` for that `effort` where None. Every
    `held_out`th frame takes no part and is reported in `meta["held_out"]` and on stderr; neither does every `held_out`th lidar sweep,
    against which the scene is measured on the path and beside it (`meta["off_path"]`). An interrupted fit leaves `<output>.fit`, at most a
    minute old; `resume` goes on from it, with the same result as if it had never stopped.
    overwrite: an existing scene is replaced once the new one is whole. device: where the fit runs and what is reported is rendered; an
    interrupted fit may go on on another device.

    The folder also keeps the photos of the fit, from which the enhancer takes detail.

    Raises ValueError for data and options that do not fit, FileExistsError where `check_free` does, KeyboardInterrupt passed on.
    """
    output = check_free(output, resume, overwrite)
    check_device(device)
    began = time.monotonic()
    names, span = choose(log, cameras, start_us, duration_us)
    check_path(log, span)
    size, config = size or fit_size(log, names), config or fit_config(log, names, span, effort)
    _check_fit_size(log, names[0], size)
    options = {"log": log.name, "cameras": names, "span_us": list(span), "size": list(size), "held_out": held_out}
    options["config"] = plain_config(config)
    checkpoint = checkpoint_path(output)
    # a drive's folder is nobody's business whom its scene is given to
    kept_options = options | {"folder": str(log.path.resolve()), "world_from_model": log.meta.get("world_from_model")}
    begun, saved = load_checkpoint(checkpoint, kept_options) if resume else (None, {})

    unseen = [s for s in held_out_sweeps(log, held_out) if span[0] <= s.time_us <= span[1]]
    sweeps = fitted(log, held_out).sweeps_within(span)
    if not saved:
        for sweep in unseen:
            sweep.read()  # they are used after the fit: a damaged one is reported before it
        check_memory(log, sweeps)
    log = readied(log, sweeps, config, names, span, size, saved.get("path"), saved.get("movers"))
    start, fit = begin(fitted(log, held_out), names, span, size, config, held_out, begun, device)
    if saved:
        fit.restore(saved)
    live = Live(fit, saved.get("live", ()))
    spent_before = float(saved.get("seconds", 0.0))

    def seconds() -> float:
        return spent_before + time.monotonic() - began

    def keep() -> None:
        so_far = {"seconds": seconds(), "live": live.curve, "path": {kind: log.meta.get(kind) for kind in KINDS}}
        so_far["movers"] = plain_tracks(log.tracks) if "movers" in log.meta else None
        save_checkpoint(checkpoint, kept_options, start, fit.tensors() | so_far)

    _run_to_end(fit, keep, live, seconds)
    keep()  # the report and the writing below may be interrupted too
    scene = assemble(fit, start, log, {"options": options})
    there = scene.to(device)
    rows = held_out_table(there, fit.frames, start.rig)
    scene.meta["held_out"] = rows
    scene.meta["fit"] = {"steps": config.steps, "splats": len(fit.splats), "seconds": round(seconds(), 1), "live": live.curve}
    print(table_text(rows), file=sys.stderr)
    if unseen:
        aside = shifts_within(fit.openings.metres)
        scene.meta["off_path"] = off_path_table(there, log, same_sweeps(log, unseen), fit.frames, aside)
        print(off_path_text(scene.meta["off_path"]), file=sys.stderr)
    _write(scene, there, fit, start, output, overwrite)
    checkpoint.unlink(missing_ok=True)
    return scene


def check_free(output: str | Path, resume: bool = False, overwrite: bool = False) -> Path:
    """A folder that a scene may be written to. FileNotFoundError where its parent does not exist, FileExistsError where it is something
    other than a scene, or a scene that is not to be overwritten, and where a fit of it was begun and is to be neither resumed nor
    overwritten."""
    output = Path(output)
    fresh(output, overwrite)
    if output.exists() and not is_scene(output):
        raise FileExistsError(f"{output} is not a scene, so it is left alone; give another name with -o")
    begun = checkpoint_path(output)
    if begun.exists() and not (resume or overwrite):
        raise FileExistsError(f"{begun} is a fit that was interrupted; go on with it by --resume, or give -w to begin again")
    return output


def _check_fit_size(log: Log, name: str, size: tuple[int, int]) -> None:
    """ValueError for a size that cannot be fitted, or is more than the first camera recorded."""
    check_size(size)
    camera = log.camera(name)
    if size[0] > camera.width or size[1] > camera.height:
        raise ValueError(f"--size {size[0]}x{size[1]} is more than {name} recorded, {camera.width}x{camera.height}; give that at most")


def _run_to_end(fit: Fit, keep: Callable[[], None], live: Live, seconds: Callable[[], float]) -> None:
    """All steps that are left, with a progress line and a checkpoint (`keep`) now and then."""
    with Progress("fit", total=fit.config.steps) as steps:
        steps.resume(fit.step_count)

        def report(fit: Fit) -> None:
            live.look(fit, seconds())
            steps.step(note="  ".join(filter(None, (str(live), f"loss {fit.recent_loss:.4f}", f"{len(fit.splats)} splats"))))

        run(fit, keep, report)


def _write(scene: Scene, there: Scene, fit: Fit, start: Start, output: Path, overwrite: bool) -> None:
    """The scene and its photos, whole or not at all; `there` is the scene on the fit's device."""
    with atomic_folder(output, overwrite) as folder, Progress("photos", total=len(fit.frames.training())) as steps:
        folder.rmdir()  # saving makes it
        save(scene, folder)
        keep_album(there, fit.frames, start.rig, folder, steps.step)
