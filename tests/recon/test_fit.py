from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from quick_fit import CONFIG, SIZE

from recon import open_log
from recon.assemble import assemble
from recon.begin import begin
from recon.checkpoint import load_checkpoint, save_checkpoint
from recon.defaults import choose
from recon.fit.config import FitConfig
from recon.fit.fit import BLAME_EVERY, Fit
from recon.fit.model import Splats
from recon.fit.openings import ASIDE_WEIGHT, HORIZON
from recon.fit.swept import Swept
from recon.fit.turns import Turns
from recon.objects.actors import split_points
from recon.seeds.measured import Measured, by_lidar, by_lidar_of_movers, mistake
from recon.views.skies import cells
from render import render_frame
from render.rays import world_directions
from scenes.poses import translation
from scenes.sky import sample_equirect, srgb_from_linear
from tests.bench.presets import random_splats


def test_splats_drawn_by_lot_are_as_dense_as_all_are_in_the_mean():
    opacity = torch.linspace(0.05, 0.45, 50)
    splats = Splats.of([replace(random_splats(50, 1, sh_count=1), logit_opacities=torch.logit(opacity))], [torch.ones(50)])
    fit = SimpleNamespace(config=FitConfig(drop=0.5), progress=0.9, generator=torch.Generator().manual_seed(1))
    draws = torch.stack([torch.sigmoid(Fit._drawn_by_lot(fit, splats).fields["logits"]) for _ in range(4000)])
    assert ((draws < 1e-4).float().mean(0) - 0.5).abs().max() < 0.04
    assert (draws.mean(0) / opacity - 1).abs().max() < 0.08
    fit.progress = 0.0
    assert Fit._drawn_by_lot(fit, splats) is splats


def test_views_come_as_often_as_they_should_and_none_waits_for_long():
    count = 12
    turns = Turns(torch.where(torch.arange(count) < count // 2, 0.4, 1.0), torch.Generator().manual_seed(0))
    share, drawn = turns.shares, torch.tensor([turns.next() for _ in range(20 * count)])
    assert (torch.bincount(drawn, minlength=count) - share * len(drawn)).abs().max() <= 1.5
    for k in range(count):
        assert (drawn == k).nonzero()[:, 0].diff().max() * share[k] <= 2
    rounds = {tuple(drawn[at : at + count].tolist()) for at in range(0, len(drawn), count)}
    assert len(rounds) > 15, "in another order each time"


def test_nothing_is_left_standing_where_something_drove(drive, monkeypatch):
    log = open_log(drive)
    names, span = choose(log)
    start, fit = begin(log, names, span, SIZE, CONFIG, 4)
    track = start.tracks[0]
    middle = track.world_from_box[len(track.world_from_box) // 2, :3, 3].float() + torch.tensor([0, 0, 0.6 * float(track.size[2])])
    fit.splats.fields["means"][:20] = middle
    assert fit.population.swept.holds(fit.splats)[:20].all()
    split = split_points(log, log.sweeps_within(span), [t for t in log.tracks if t.moving])
    tracks = [*split.tracks, *(t for t in log.tracks if not t.moving)]
    taken = np.array([s.time_us for s in log.sweeps])[np.searchsorted([s.index for s in log.sweeps], split.static_sweep)]
    assert torch.equal(start.swept.keys, Swept.by(tracks, span, start.ground, split.static, taken).keys)
    fit.population.grow(fit.progress)
    assert not fit.population.swept.holds(fit.splats).any()
    fit.splats.fields["means"][:20] = middle
    count, tensors = len(fit.splats), fit.population.descent.tensors()
    squares, last = tensors["moments"][:, 1].uniform_().clone(), tensors["last"].random_(90).clone()
    stays = ~(fit.population.swept.holds(fit.splats) | fit.population.clear.holds(fit.splats))
    assert not stays[:20].any() and stays[20:].float().mean() > 0.9
    monkeypatch.setattr("recon.fit.population.halves", lambda *told: ([], []))  # which would change the cars
    for hanging in ("curtains", "pennants"):  # which beyond the pictures' borders there are
        monkeypatch.setattr(f"recon.fit.population.{hanging}", lambda splats, *told: torch.zeros(len(splats), dtype=torch.bool))
    fit.population.guess(fit.shown)
    tensors = fit.population.descent.tensors()
    assert torch.equal(tensors["moments"][:, 1], squares[stays]) and torch.equal(tensors["last"], last[stays])
    assert fit.population.guessed.shape == (int(stays.sum()),) and len(fit.splats) == stays.sum() < count, "nothing is split"
    assert not fit.population.swept.holds(fit.splats).any(), "what came later, too"


def test_a_start_measures_what_moves_too_and_is_what_a_checkpoint_keeps(drive, tmp_path):
    log = open_log(drive)
    names, span = choose(log)
    start, fit = begin(log, names, span, SIZE, CONFIG, 4)
    sweeps, movers = log.sweeps_within(span), [t for t in log.tracks if t.moving]
    split = split_points(log, sweeps, movers)
    still = by_lidar(log, fit.frames, sweeps, split, movers).views
    moving = by_lidar_of_movers(log, fit.frames, sweeps, split).views
    depths = start.measured[0].views
    assert sum(int(depth.isfinite().sum()) for depth in still.values()) > 100
    for which, depth in still.items():
        assert torch.equal(depths[which][depth.isfinite()], depth[depth.isfinite()])
    more = {which: depth.isfinite() & still[which].isnan() for which, depth in moving.items()}
    assert sum(int(m.sum()) for m in more.values()) > 30
    assert all(torch.equal(depths[which][m], moving[which][m]) for which, m in more.items())

    save_checkpoint(tmp_path / "scene.fit", {}, start, fit.tensors())
    kept = load_checkpoint(tmp_path / "scene.fit", {})[0]
    assert len(kept.swept.keys) and torch.equal(kept.swept.keys, start.swept.keys)
    assert all(torch.equal(m.nan_to_num(), kept.measured[0].views[w].nan_to_num()) for w, m in depths.items())


def test_a_fit_moves_boxes_by_what_they_may_be_off_and_goes_on_so(drive, tmp_path):
    log = open_log(drive)
    names, span = choose(log)
    log = replace(log, tracks=tuple(replace(t, off=0.2) for t in log.tracks))
    start, fit = begin(log, names, span, SIZE, CONFIG, 4)
    assert [t.off for t in start.tracks] == [0.2]
    before = fit.motion.trajectory(0).world_from_body
    fit.motion.paths.data[:, 3] = 1.0  # forward
    went = (before.inverse() @ fit.motion.trajectory(0).world_from_body)[:, :3, 3]
    assert torch.allclose(went, torch.tensor([0.2, 0, 0], dtype=went.dtype).expand_as(went), atol=1e-6)
    save_checkpoint(tmp_path / "scene.fit", {}, start, fit.tensors())
    assert [t.off for t in load_checkpoint(tmp_path / "scene.fit", {})[0].tracks] == [0.2]


def test_a_fit_goes_on_under_the_sky_that_it_began_with(drive, tmp_path):
    """What points of pictures told of it is not sought again."""
    log = open_log(drive)
    names, span = choose(log, ["front_camera"])
    start, fit = begin(log, names, span, (48, 27), CONFIG, 4)
    told = tuple(torch.rand(sky.shape) < 0.5 for sky in start.skies)
    save_checkpoint(tmp_path / "scene.fit", {}, replace(start, skies=told), fit.tensors())
    kept = load_checkpoint(tmp_path / "scene.fit", {})[0]
    again = begin(log, names, span, (48, 27), CONFIG, 4, kept)[1]
    assert all(torch.equal(view.sky, sky) for view, sky in zip(again.frames.views, told, strict=True))


def test_what_the_sky_stands_in_for_comes_back(drive):
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    for _ in range(12):
        fit.step()
    view = fit.training[3]
    whole = fit._drawn(view, "rgb", "alpha")["alpha"].detach()
    above = (fit.splats.fields["means"][:, 2] > 1.0) & (fit.splats.group_of() == 0)
    fit.population.drop(above | fit.population.clear.holds(fit.splats))  # as it would
    count, end = len(fit.splats), fit.splats.sizes[0]
    rest = {k: t.clone() for k, t in (fit.splats.fields | fit.population.descent.tensors()).items()}
    torn = fit._drawn(view, "rgb", "alpha")["alpha"].detach()
    lost = (whole > 0.9) & (torn < 0.1)
    assert lost.sum() > 40
    fit._refill()
    new = len(fit.splats) - count
    assert new > 5 and fit.splats.sizes[0] == end + new and len(fit.population.growth.errors) == len(fit.splats)
    after = fit.splats.fields | fit.population.descent.tensors()
    assert all(torch.equal(torch.cat([t[:end], t[end + new :]]), rest[k]) for k, t in after.items())
    assert not fit.population.descent.moments[end : end + new].any()
    found = fit._drawn(view, "rgb", "alpha")["alpha"].detach()
    assert (found[lost] > 0.5).float().mean() > 0.6
    fit._refill()
    assert len(fit.splats) < count + 1.5 * new, "what is there does not come again"
    fit.step()


def test_at_night_a_sky_that_nothing_shows_does_not_shine(own_drive):
    """From aside it is seen beyond the pictures' borders."""
    for file in own_drive.glob("camera/*/*.jpg"):
        Image.fromarray((np.asarray(Image.open(file)) * 0.1).astype(np.uint8)).save(file, quality=95)
    log = open_log(own_drive)
    names, span = choose(log)
    start, fit = begin(log, names, span, SIZE, CONFIG, 4)
    assert max(float(v.image.float().mean()) for v in fit.training) / 255 < 0.1
    assert start.sky.max() < 0.15


def test_a_sky_as_bright_as_the_darkest_camera_tells_is_kept(drive):
    """The sun is white in every picture but in those of a camera that is exposed half as long."""
    log = open_log(drive)
    names, span = choose(log)
    start, fit = begin(log, names, span, SIZE, CONFIG, 4)
    with torch.no_grad():
        fit.sky.fill_(1.9)
        fit.exposures[:, :, :3] = torch.eye(3)
    assert float(srgb_from_linear(assemble(fit, start, log).sky.linear).max()) == pytest.approx(1, abs=1e-3)
    with torch.no_grad():
        fit.exposures[-1, :, :3] = 0.5 * torch.eye(3)
    scene = assemble(fit, start, log)
    camera = scene.camera(names[-1], span[0])
    upwards = translation(*camera.world_from_cam[:3, 3].tolist())
    assert float(render_frame(scene, replace(camera, world_from_cam=upwards)).rgb.median()) == pytest.approx(0.95, abs=0.01)


def test_splats_are_blamed_for_what_is_wrong_in_the_pixels_that_show_them(drive):
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    fit.step_count = BLAME_EVERY * 4
    view = fit.training[0]
    fit.turns.shares = torch.eye(len(fit.training))[0]  # the view that is drawn
    shot = fit.motion.shot(view, fit.targets.size(view, fit.shrink()))
    everything = fit.splats.select(torch.arange(len(fit.splats)), fit.sh_count())
    ones, sky = torch.ones(len(fit.splats), 1), partial(sample_equirect, fit.sky)
    with torch.no_grad():
        drawn = fit._render(everything, shot, sky, outputs=("rgb", "alpha", "features"), features=ones)
    alpha = drawn["alpha"]
    torch.testing.assert_close(drawn["features"][..., 0], alpha)  # a picture's weights of all splats are its alpha
    wrong = (drawn["rgb"] - fit.targets.picture(view, fit.shrink())).abs().mean(-1)
    fit.step()
    assert abs(float(fit.population.growth.errors.sum() / (wrong * alpha).sum()) / fit.shrink() ** 2 - 1) < 0.1, (
        "but for what the backdrop changes where alpha is low"
    )
    assert (fit.population.growth.errors >= 0).all()
    assert fit.population.growth.shown.max() == 1
    before = fit.population.growth.errors.clone()
    fit.step()
    assert torch.equal(fit.population.growth.errors, before), "only now and then"


@torch.no_grad()
def _mistakes(fit):
    found = []
    for view in fit.training:
        shot = fit.motion.shot(view, SIZE)
        shown = fit.splats.select(torch.arange(len(fit.splats)), fit.sh_count())
        drawn = fit._render(shown, shot, partial(sample_equirect, fit.sky), outputs=("rgb", "alpha", "depth"))
        found.append(float(mistake(drawn["depth"], drawn["alpha"], fit.measured[0].views[view.camera, view.index][None])))
    return np.mean(found)


def test_depth_follows_what_was_measured(drive):
    log = open_log(drive)
    names, span = choose(log)
    after = []
    for weight in (0.0, 1.0):
        _, fit = begin(log, names, span, SIZE, replace(CONFIG, steps=400, depth_weight=weight), 4)
        assert [len(m.views) for m in fit.measured[:2]] == 2 * [len(fit.training)]
        fit.measured = [Measured({k: 1.15 * depth for k, depth in fit.measured[0].views.items()}, 0.5)]
        before = _mistakes(fit)
        for _ in range(40):
            fit.step()
        after.append(_mistakes(fit) / before)
    assert after[0] > 0.9 and after[1] < 0.8 * after[0]


def test_from_aside_nothing_may_be_open_where_the_sky_is_never_seen(drive):
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    view = fit.training[0]
    camera = fit.openings.aside(view, fit.motion.camera(view), 2.0)
    nothing = torch.zeros(camera.height, camera.width)
    below = float((world_directions(camera)[..., 2] < HORIZON).float().mean())
    open_ = float(fit.openings.gaps(nothing, camera)) / ASIDE_WEIGHT
    assert below + 0.1 < open_ < 0.9, "houses above the horizon count, and the sky does not"
    fit.openings.hidden[:] = False
    assert float(fit.openings.gaps(nothing, camera)) / ASIDE_WEIGHT == pytest.approx(below)
    assert float(fit.openings.gaps(1 - nothing, camera)) == 0


def test_of_opaque_splats_before_the_sky_each_is_asked_to_go(drive):
    """The one behind another, too, without which the picture would not be one bit clearer."""
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    view = fit.training[0]
    camera = fit.motion.camera(view)
    assert 0.05 < float(fit.openings.sky[view.camera, view.index].float().mean()) < 0.9
    pulls = []
    for other in (0.0, 0.9):
        opacity = torch.tensor(0.9, requires_grad=True)
        alpha = (1 - (1 - opacity) * (1 - other)).expand(camera.height, camera.width)
        fit.openings.haze(alpha, view, camera).backward()
        pulls.append(float(opacity.grad))
    assert pulls[1] > pulls[0] / 3 > 0, "alpha itself would pull a tenth as much"


def test_behind_what_always_hides_the_sky_is_no_light_to_rely_on(drive):
    log = open_log(drive)
    names, span = choose(log)
    _, fit = begin(log, names, span, SIZE, CONFIG, 4)
    camera = fit.motion.camera(fit.training[0])
    directions = world_directions(camera)
    hidden = fit.openings.hidden[cells(directions, len(fit.openings.hidden))]
    assert 0.2 < float(hidden.float().mean()) < 0.95
    plain = sample_equirect(fit.sky, directions).detach()
    first, second = (fit.openings.backdrop(fit.sky, fit.generator)(directions) for _ in range(2))
    open_ = torch.nn.functional.max_pool2d((~hidden)[None, None].float(), 3, 1, 1)[0, 0] > 0
    assert (open_ & hidden).any()
    for shown in (first, second):
        torch.testing.assert_close(shown[open_], plain[open_])  # and beside what is open, or its grey would be seen there
        assert (shown[~open_] == shown[~open_][0, 0]).all()
    assert float((first - second).detach()[~open_].abs().min()) > 0.01
    first[~hidden].sum().backward()
    assert fit.sky.grad is not None and fit.sky.grad.any()
    fit.sky.grad = None
    second[~open_].sum().backward()
    assert not fit.sky.grad.any()
