"""A fit before its first step: its pictures are loaded, and its initial splats prepared."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace

import torch

from recon.defaults import HELD_OUT
from recon.fit.clear import Clear
from recon.fit.config import FitConfig
from recon.fit.fit import Fit
from recon.fit.flat import FlatGround
from recon.fit.flat_field import FlatField
from recon.fit.knots import Knots
from recon.fit.limbs import Limbs
from recon.fit.motion import Motion
from recon.fit.population import Population
from recon.fit.reach import nearest_of
from recon.fit.strides import stride_of
from recon.fit.veils import Veils
from recon.log import Log
from recon.objects.tracks import LIMBED
from recon.ready import moving_things
from recon.seeds.sunken import without_sunken
from recon.seeds.triangulate import triangulated
from recon.start import Start, prepare
from recon.views.exposed import exposed_by
from recon.views.frames import Frames, load_frames
from recon.views.sky_told import under_their_sky
from render.progress import Progress
from scenes.camera import RigCamera


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

    names, span: cameras, and first and last microsecond (`choose`). size: width and height of the first camera's pictures. exposed: cameras
    by name as a scene has them, whose exposures, frames' gains and flat fields are taken; estimated where None.
    """
    estimated = start is None and exposed is None and "gains" in config.refine  # else they are known
    with Progress("images") as steps:
        frames = load_frames(log, names, span, size, held_out, steps.step, estimated)
    if exposed is not None:
        frames = replace(frames, views=[replace(v, gain=exposed[names[v.camera]].gain_at(v.time_us)) for v in frames.views])
    if start is None:
        frames, start = _prepared(log, names, frames, span, config, estimated, exposed)
    else:
        told = zip(frames.views, start.gains, start.skies, strict=True)
        frames = replace(frames, views=[replace(v, gain=gain, sky=sky) for v, gain, sky in told])
    seen = [] if log.sweeps_within(span) else [frames.camera(log, view) for view in frames.training()]
    veils = Veils.of(seen, start.tracks, start.ground)
    return start, _fit(frames, start, Clear.of(log, span, start.ground), veils, config, device, exposed or {})


def _prepared(
    log: Log,
    names: list[str],
    frames: Frames,
    span: tuple[int, int],
    config: FitConfig,
    estimated: bool,
    exposed: Mapping[str, RigCamera] | None,
) -> tuple[Frames, Start]:
    """The frames, with what sparse points tell of their skies and, where they are to be `estimated`, their gains; and what a fit of them
    starts from."""
    driven, sparse = log.ego.within(span), log.points
    if sparse is not None:
        sparse = without_sunken(sparse, log, driven)
    elif not log.sweeps_within(span):
        sparse = without_sunken(triangulated(log, frames), log, driven)
        frames = replace(frames, views=under_their_sky(log, names, frames.views, sparse))
        if estimated:
            frames = replace(frames, views=exposed_by(sparse, log, names, frames.views))
    with Progress("prepare") as steps:
        coefficients = (config.sh_degree + 1) ** 2
        known = None if exposed is None else torch.stack([exposed[name].exposure for name in names])
        start = prepare(log, frames, span, config.budget, coefficients, lambda what: steps.step(note=what), sparse, known)
    if sparse is not None and not log.tracks:
        found = moving_things(len(start.tracks))
        print(f"{log.path} has neither boxes nor lidar: its pictures show {found}", file=sys.stderr)
    return frames, start


def _fit(frames: Frames, start: Start, clear: Clear, veils: Veils, config: FitConfig, device: str, exposed: Mapping[str, RigCamera]) -> Fit:
    """The fit of prepared splats, with all that constrains it."""
    trained = torch.tensor([v.time_us for v in frames.of(0)])
    motion = Motion(frames, start.rig, Knots(start.ego, trained), start.tracks)
    limbed = [(i + 1, t) for i, t in enumerate(start.tracks) if t.label in LIMBED and "limbs" in config.refine]
    strides = {group: stride for group, track in limbed if (stride := stride_of(track, frames, motion))}
    times = [v.time_us for v in frames.views]
    limbs = Limbs(strides, start.tracks, (min(times), max(times)), device)
    ground = FlatGround(start.ground, start.ground_shown, torch.device(device))
    population = Population(start.splats.to(device), motion, config, ground, start.swept, clear, veils, nearest_of(start.measured))
    fields = [_flat_field(start.rig[name], exposed.get(name), population.device) for name in frames.names]
    return Fit(frames, population, start.sky, start.exposures, limbs, start.measured, fields)


def _flat_field(camera: RigCamera, known: RigCamera | None, device: torch.device) -> FlatField:
    """A camera's flat field before the fit: as it is known, or even."""
    if known is None or known.flat_field is None:
        return FlatField.even(camera.width, camera.height, device)
    return FlatField(known.flat_field.to(device))
