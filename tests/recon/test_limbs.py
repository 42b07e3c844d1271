"""People who walk: the length of their strides is found, and their limbs follow."""

import copy
import math
from dataclasses import replace

import pytest
import torch
import walker

from recon.assemble import assemble
from recon.assets.extract import at_rest
from recon.begin import begin
from recon.body_path import body_path
from recon.defaults import choose
from recon.fit.config import FitConfig
from recon.fit.fit import Fit
from recon.fit.knots import Knots
from recon.fit.motion import Motion
from recon.fit.strides import stride_of
from recon.objects.tracks import LIMBED
from recon.views.frames import load_frames
from render import render_frame
from scenes import Scene

SIZE = (112, 64)
CONFIG = FitConfig(steps=120, budget=9_000, stages=((0.0, 1),), grow_every=30, sh_degree=0)


def log_of(**walk):
    return walker.log_of(walker.walk(24, *SIZE, **walk))


@pytest.fixture(scope="module")
def walk():
    return log_of()


def begun(log, config=CONFIG):
    names, span = choose(log, ["front_camera"])
    return begin(log, names, span, SIZE, config)


def run(fit: Fit, until: int) -> Fit:
    while fit.step_count < until:
        fit.step()
    return fit


@pytest.fixture(scope="module")
def fitted(walk):
    """The scene with limbs, and without."""
    made = []
    for refine in (CONFIG.refine, tuple(r for r in CONFIG.refine if r != "limbs")):
        start, fit = begun(walk, replace(CONFIG, refine=refine))
        made.append((assemble(run(fit, CONFIG.steps), start, walk), fit.frames))
    return made


@pytest.mark.parametrize("part", [0.65, 1.0])
def test_the_length_of_strides_is_found(part, monkeypatch):
    monkeypatch.setattr(walker, "STRIDE", part)
    start, fit = begun(log_of())
    gaits = {start.tracks[group - 1].name: limb.gait for group, limb in fit.limbs.of.items()}
    assert "ped_2" in gaits, "the one who is in view throughout walks"
    track = next(t for t in start.tracks if t.name == "ped_2")
    times = next(limb.times_us for group, limb in fit.limbs.of.items() if start.tracks[group - 1].name == "ped_2")
    gone = float((track.trajectory().near(int(times[-1])) - track.trajectory().near(int(times[0])))[:3, 3].norm())
    turns = torch.atan2(gaits["ped_2"][:, 1], gaits["ped_2"][:, 0]).double().diff()
    strides = float(turns.remainder(2 * math.pi).sum()) / (2 * math.pi)
    assert gone / strides == pytest.approx(part * 1.75, rel=0.06)


@pytest.mark.parametrize("stiff", [(), ("ped_1",)], ids=["walks", "stiff"])
def test_who_crosses_on_stripes_walks_if_his_legs_do(stiff):
    """The stripes pass behind them as regularly."""
    size = (224, 126)
    log = walker.log_of(walker.walk(32, *size, stiff=stiff, striped=True))
    names, span = choose(log, ["front_camera"])
    frames = load_frames(log, names, span, size, 8)
    rig = log.rig(dict(zip(frames.names, frames.sizes, strict=True)))
    knots = Knots(body_path(log, frames, rig), torch.tensor([v.time_us for v in frames.of(0)]))
    found = stride_of(log.tracks[0], frames, Motion(frames, rig, knots, list(log.tracks)))
    assert found is None if stiff else found == pytest.approx(walker.STRIDE * walker.SIZE[2], rel=0.05)


def test_who_holds_still_has_no_limbs_and_what_has_none_is_not_looked_at(walk):
    assert begun(log_of(stiff=("ped_1", "ped_2")))[1].limbs.of.keys() == set()
    cars = replace(walk, tracks=tuple(replace(t, label="car") for t in walk.tracks))
    assert begun(cars)[1].limbs.of.keys() == set()
    assert {"pedestrian", "cyclist", "bicycle", "motorcycle", "scooter"} <= LIMBED


def squares(scene: Scene, frames) -> float:
    """Mean square over the people's pixels of held-out frames."""
    truth, times, off = walker.walk(24, *SIZE), scene.frame_times("front_camera"), []
    for view in frames.of(0, held_out=True):
        with torch.no_grad():
            shown = render_frame(truth, truth.camera("front_camera", view.time_us), ("instance",)).instance > 0
            rgb = render_frame(scene, scene.camera("front_camera", int(times[view.index]))).rgb
        off.append((rgb - view.image.float() / 255)[shown])
    return float(torch.cat(off).square().mean())


def test_limbs_bring_held_out_people_nearer(fitted):
    (with_limbs, frames), (without, _) = fitted
    gain = 10 * math.log10(squares(without, frames) / squares(with_limbs, frames))
    assert gain > 1.0, f"{gain:.2f} dB"
    assert all(a.deformation is None for a in without.actors)


def test_legs_do_not_tear(fitted):
    """Neighbouring splats of a person stay neighbours at all times: no two within 5 cm are pulled apart by more than twice that."""
    actor = next(a for a in fitted[0][0].actors if a.track == "ped_2")
    means = actor.asset.gaussians.means
    near = (torch.cdist(means, means) < 0.05).nonzero()
    for time in actor.deformation.times_us.tolist():
        moved = actor.deformation.at(time).at(means)
        assert moved.abs().max() < 0.8
        assert (moved[near[:, 0]] - moved[near[:, 1]]).norm(dim=1).max() < 0.1


def test_an_extracted_person_stands_as_it_once_did(fitted):
    actor = next(a for a in fitted[0][0].actors if a.track == "ped_2")
    means, rest = actor.asset.gaussians.means, at_rest(actor).means
    moved = [float(actor.deformation.at(t).at(means).norm()) for t in actor.deformation.times_us.tolist()]
    assert float((rest - means).norm()) == pytest.approx(min(moved)) and max(moved) > 1.2 * min(moved)
    assert at_rest(replace(actor, deformation=None)) is actor.asset.gaussians


def test_a_fit_with_limbs_goes_on_from_its_checkpoint_as_if_it_had_never_stopped(walk):
    _, whole = begun(walk)
    state = copy.deepcopy(run(whole, 6).tensors())
    run(whole, 12)
    _, other = begun(walk)
    other.restore(state)
    run(other, 12)
    for group, limb in whole.limbs.of.items():
        assert limb.modes.any() and torch.equal(limb.modes, other.limbs.of[group].modes)
        assert torch.equal(limb.added, other.limbs.of[group].added)
    assert torch.equal(whole.splats.fields["means"], other.splats.fields["means"])
