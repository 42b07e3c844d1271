import numpy as np
import pytest
import torch
from painted import SIZE, WALL, depth_of, drive

from recon.ground import estimate_ground
from recon.log import Log
from recon.seeds import dense, measured, stereo
from recon.seeds.beyond import _beyond, _points, _seen_through, beyond_lidar
from recon.seeds.dense import DUG, Depths, believed
from recon.seeds.measured import Measured, as_known, grid_of
from recon.seeds.stereo import plate_of
from recon.views.frames import load_frames

STEPS = [0.0] + [0.6] * 8


@pytest.fixture(scope="module", autouse=True)
def few_pictures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dense, "VIEWS", (6, 10))
        patch.setattr(stereo, "WIDTH", 160)
        patch.setattr(measured, "WIDTH", 160)
        yield


def _struck(log: Log, frames, reached) -> Measured:
    """What a lidar measures of each training view where `reached` (a row's part of the picture) says so."""
    depths = {}
    for view in frames.training():
        camera = grid_of(log.camera("front").camera(view.index, *SIZE))
        rows = (torch.arange(camera.height)[:, None] + 0.5) / camera.height
        depths[view.camera, view.index] = as_known(np.where(reached(rows), depth_of(camera), np.nan))
    return Measured(depths, 0.25)


@pytest.fixture(scope="module")
def made():
    log = drive(STEPS, ("front",))
    frames = load_frames(log, ["front"], (0, 10**18), SIZE, 0)
    road = np.stack(np.meshgrid(np.arange(-5, 25, 0.5), np.arange(-10, 10, 0.5), [0.0]), -1).reshape(-1, 3)
    return log, frames, estimate_ground(road, log.ego)


def test_what_stands_above_the_beams_is_found_in_pictures(made):
    log, frames, ground = made
    struck = _struck(log, frames, lambda row: row > 0.65)  # the road, and nothing of the wall
    cloud, found = beyond_lidar(log, frames, struck, ground, [], np.full((1, 3), 0.5))
    off = np.abs(cloud.xyz[:, 0] / WALL - 1)
    assert np.median(off) < 0.02 and (off < 0.05).mean() > 0.9
    assert cloud.xyz[:, 2].min() > -DUG, "nothing under the road"
    assert len(cloud.xyz) > 20_000, "most of what it has not"
    assert 0.9 < cloud.rgb.mean() < 1.1, "blotches are grey in the mean, and this camera is exposed by half"
    assert found.weight == struck.weight
    for which, depth in found.views.items():
        assert not (depth.isfinite() & struck.views[which].isfinite()).any(), "nothing where lidar has measured"
        assert not (found.without(struck).views[which].isfinite() ^ depth.isfinite()).any()
        assert not struck.without(struck).views[which].isfinite().any()
    assert sum(int(depth.isfinite().sum()) for depth in found.views.values()) > 20_000


def test_a_car_that_waits_finds_nothing():
    log = drive([0.0] + [0.001, -0.002, 0.001] * 3, ("front",))
    frames = load_frames(log, ["front"], (0, 10**18), SIZE, 0)
    road = np.stack(np.meshgrid(np.arange(-5, 25, 0.5), np.arange(-10, 10, 0.5), [0.0]), -1).reshape(-1, 3)
    struck = _struck(log, frames, lambda row: row > 0.65)
    cloud, _ = beyond_lidar(log, frames, struck, estimate_ground(road, log.ego), [], np.ones((1, 3)))
    assert len(cloud.xyz) == 0, "of a shaking car, pictures look alike at any depth"


def test_nothing_is_looked_for_where_lidar_saw_all_or_nothing(made):
    log, frames, ground = made
    for reached in (lambda row: row > 0, lambda row: row > 2):
        cloud, _ = beyond_lidar(log, frames, _struck(log, frames, reached), ground, [], np.ones((1, 3)))
        assert cloud.xyz.shape == (0, 3)
        assert cloud.rgb.shape == (0, 3)


def test_between_beams_nothing_is_looked_for(made):
    log, frames, ground = made
    beams = _struck(log, frames, lambda row: (row * 90 % 5 >= 4) & (row > 0.3))
    cloud, _ = beyond_lidar(log, frames, beams, ground, [], np.ones((1, 3)))
    assert len(cloud.xyz) > 5_000
    assert cloud.xyz[:, 2].min() > 2, "the beams' highest row is a fifth of the picture above the horizon"


def test_what_more_sweeps_see_through_than_strike_is_not_believed(made):
    log, frames, ground = made
    struck = _struck(log, frames, lambda row: row > 0.65)
    grids = {k: grid_of(log.camera("front").camera(k[1], *SIZE)) for k in struck.views}
    own = believed(log, frames, _points(log, frames, struck, grids), ground, [])[0]
    wall = own.only(own.points()[..., 2] > 2)
    share = np.isfinite(wall.depth).mean()
    assert share > 0.2
    full = _struck(log, frames, lambda row: row > 0)
    for through, expected in ((1, 0.0), (8, share)):  # of nine views, not all of which show all of it
        beams = {k: d if i >= through else torch.full_like(d, 60.0) for i, (k, d) in enumerate(full.views.items())}
        assert abs(_seen_through(wall, Measured(beams, 0.25), grids).mean() - expected) < 0.1 * share, through


def test_plain_walls_are_not_guessed(made):
    log, frames, _ = made
    view, camera = frames.views[0], log.camera("front").camera(0, *SIZE)
    half = view.image.clone()
    half[:90, :160] = 210  # of the wall, its left half
    plate = plate_of(half, camera)
    own = Depths(view, camera, plate, depth_of(camera.resized(160, 90)).numpy())
    asked = _beyond(own, _struck(log, frames, lambda row: row > 0.65))
    assert not asked[:42, :77].any()
    assert asked[:42, 83:].mean() > 0.95
    assert not asked[62:].any(), "there lidar has measured"
