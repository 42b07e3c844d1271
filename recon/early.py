"""Reconstructions stopped early: what an unfinished fit of a drive looks like, at several points of its schedule."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from recon.assemble import assemble
from recon.begin import begin
from recon.defaults import choose
from recon.fit.config import FitConfig
from recon.log import Log
from recon.ready import annotated
from render.progress import Progress
from scenes.files import save
from scenes.usd.metadata import is_scene

SHARES = (0.25, 0.5, 0.75)
SHORT = FitConfig(steps=2400, budget=100_000)
SIZE = (640, 360)


def stopped_early(
    log: Log,
    folder: str | Path,
    cameras: Sequence[str] | None = None,
    shares: Sequence[float] = SHARES,
    size: tuple[int, int] = SIZE,
    config: FitConfig = SHORT,
    device: str = "cpu",
) -> list[Path]:
    """Fit once and write the scene at each of `shares` of the schedule to `<folder>/<percent>`; returns those folders.

    cameras, device: as `reconstruct`. size: width and height of the pictures that are fitted. Scenes that are there already are kept: an
    interrupted call begins the fit again, which takes minutes, but writes only what is missing.
    """
    if not shares or not all(0 < share <= 1 for share in shares):
        raise ValueError(f"shares of the schedule must lie above 0 and up to 1, got {tuple(shares)}")
    folder = Path(folder)
    paths = {round(share * config.steps): folder / f"{round(100 * share)}" for share in sorted(shares)}
    if all(is_scene(path) for path in paths.values()):
        return list(paths.values())
    folder.mkdir(parents=True, exist_ok=True)
    names, span = choose(log, cameras)
    log = annotated(log, log.sweeps_within(span))
    start, fit = begin(log, names, span, size, config, device=device)
    with Progress(f"fit {folder.name}", total=max(paths)) as steps:
        while fit.step_count < max(paths):
            fit.step()
            steps.step(note=f"loss {fit.recent_loss:.4f}  {len(fit.splats)} splats")
            path = paths.get(fit.step_count)
            if path is not None and not is_scene(path):
                save(assemble(fit, start, log, {"name": f"{log.name} at {path.name} percent"}), path)
    return list(paths.values())
