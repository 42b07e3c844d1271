"""A log as a fit takes it: without the held-out sweeps, its path and mounts corrected, with boxes of what moves."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace

from recon.checkpoint import tracks_of
from recon.evaluation.offpath import held_out_sweeps
from recon.fit.config import FitConfig
from recon.log import Log, Sweep, Track
from recon.movers.search import with_movers
from recon.movers.stamped import as_drawn
from recon.movers.steadying import steadied
from recon.objects.leaning import leaning
from recon.registration.adjust import adjusted
from recon.registration.align import aligned
from recon.registration.corrected import as_corrected
from recon.registration.mounts_by_road import mounts_by_road
from recon.registration.mounts_by_surfaces import mounts_by_surfaces
from render.progress import Progress


def fitted(log: Log, held_out: int) -> Log:
    """The log without the sweeps against which a scene is measured."""
    unseen = held_out_sweeps(log, held_out)
    return replace(log, sweeps=tuple(s for s in log.sweeps if s not in unseen))


def readied(
    log: Log,
    sweeps: Sequence[Sweep],
    config: FitConfig,
    names: Sequence[str],
    span: tuple[int, int],
    size: tuple[int, int],
    known: dict | None = None,
    movers: Sequence[dict] | None = None,
) -> Log:
    """The log with its path and camera mounts corrected, and with the movers that its lidar shows where it has no boxes.

    sweeps: those that the fit may use; without any, pictures correct the path. names, span, size: cameras, first and last microsecond, and
    the size at which pictures are looked at. known: corrections that were found before (`as_corrected`), movers: the tracks that were
    (`plain_tracks`); found anew where None.
    """
    log = _corrected(log, sweeps, config, names, span, size) if known is None else as_corrected(log, known)
    if movers is not None:
        return _moved_by(log, tracks_of(movers))
    return annotated(log, same_sweeps(log, sweeps))


def _corrected(
    log: Log, sweeps: Sequence[Sweep], config: FitConfig, names: Sequence[str], span: tuple[int, int], size: tuple[int, int]
) -> Log:
    """The log with its path and its cameras' mounts corrected by what lidar and pictures show."""
    if not sweeps:  # poses that come from the pictures meet in them
        return adjusted(log, names[0], span, size) if "path" in config.refine and log.points is None else log
    if "path" in config.refine:
        with Progress("sweeps") as steps:
            log = aligned(log, sweeps, steps.step)
    if "surfaces" in config.refine:
        with Progress("surfaces", total=len(names)) as steps:
            log = mounts_by_surfaces(log, names, same_sweeps(log, sweeps), span, steps.step)
    if "road" in config.refine:
        with Progress("mounts", total=len(names)) as steps:
            log = mounts_by_road(log, names, same_sweeps(log, sweeps), span, steps.step)
    return log


def same_sweeps(log: Log, sweeps: Sequence[Sweep]) -> list[Sweep]:
    """Sweeps as a log has them whose path was corrected since they were taken from it."""
    indices = {s.index for s in sweeps}
    return [s for s in log.sweeps if s.index in indices]


def annotated(log: Log, sweeps: Sequence[Sweep]) -> Log:
    """The log, with the movers that `sweeps` show where it has no boxes of its own; boxes lie where their points meet, and on a hill
    lean as the road does."""
    if log.tracks:
        log = as_drawn(log, sweeps)
    elif sweeps:
        with Progress("movers", total=len(sweeps)) as steps:
            found = with_movers(log, sweeps, steps.step)
        print(f"{log.path} has no boxes: its lidar shows {moving_things(len(found.tracks))}", file=sys.stderr)
        log = _moved_by(log, found.tracks)
    return leaning(steadied(log, sweeps), sweeps)


def moving_things(count: int) -> str:
    """A number of movers in words."""
    return f"{count} thing{'s that move' if count != 1 else ' that moves'}"


def _moved_by(log: Log, tracks: Sequence[Track]) -> Log:
    return replace(log, tracks=tuple(tracks), meta={**log.meta, "movers": "found in lidar"})
